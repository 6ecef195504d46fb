"""Courses: one robot in every world walks and jumps as its script says, and switches between its skills for it.

For a jump the robot is commanded to stand and asked for the jump with its goal. The jump takes over once the robot is
at rest, and hands back by itself (`kernels.skills.handovers`). A robot that does not come to rest walks on a little.
Velocities go from one command to the next at a limited rate.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from jumper_warp.evaluation.log import EvaluationLog, Metrics, failures, finite, largest, mean
from jumper_warp.evaluation.plots import figure
from jumper_warp.evaluation.scripts import ScriptStep
from jumper_warp.evaluation.velocities import SKIP, body_velocity, rmse_metrics, velocity_series
from jumper_warp.policies.skills import JUMP_TO, JUMP_UP, WALK
from jumper_warp.robot.grounds import BlockCfg
from jumper_warp.tasks.switching import FALLS
from jumper_warp.utils.errors import InputError

SKILL_OF = {"walk": WALK, "stand": WALK, "jump_up": JUMP_UP, "jump_to": JUMP_TO, "jump_onto": JUMP_TO}
BLOCK = BlockCfg(center=(1.0e3, 1.0e3), half=(0.55, 0.55), height=0.05, mass=10.0, friction=0.4)
"""What robots jump onto: far away until then, under the goal from when the jump takes over."""
SQUAT = 0.5
"""[s] From when a jump takes over, and squats as it does at the start of its episodes, to its command."""
SLEW = 1.25
"""[m/s^2], [rad/s^2] How fast a velocity is taken from one command to the next."""
NUDGE_AFTER, NUDGE_FOR = 2.0, 0.5
"""[s] Without a jump after which a robot walks on, and how long, so that it plants its paws anew."""
NUDGE = (0.25, 0.0, 0.0)
"""[m/s], [rad/s] How it does."""
PATIENCE = 15.0
"""[s] After which a jump that is not over has failed."""
STUCK, DONE = len(FALLS), len(FALLS) + 1
OUTCOMES = (*(term.name for term in FALLS), "stuck", "done")
SETTLED, LANDED_PHASE = 0.1, 2
"""[m] Error up to which a jump is on its goal; the jump's phase after touchdown."""
QUIET = 0.2
"""[s] Before a jump takes over, in which paw forces are looked at."""
COLOURS = {WALK: "white", JUMP_UP: "tab:orange", JUMP_TO: "tab:purple"}
NAMES = {WALK: "walk", JUMP_UP: "jump up", JUMP_TO: "jump to"}


@dataclass
class Course(EvaluationLog):
    """What became of every robot's course; nothing of a robot counts after its end."""

    scripts: Sequence[Sequence[ScriptStep]]
    """One a robot, all of as many commands."""
    headings: np.ndarray | float = 0.0
    """[rad] (robots,) At the start."""
    row = "robot"
    spacing = 2.0

    def __post_init__(self) -> None:
        """Begin with nothing done. Raises InputError: scripts of different lengths."""
        lengths = {len(script) for script in self.scripts}
        if len(lengths) != 1 or 0 in lengths:
            raise InputError(f"a course needs scripts of one length, got {sorted(lengths)} commands")
        n, k = shape = len(self.scripts), lengths.pop()
        self.onto = np.array([[step.kind == "jump_onto" for step in script] for script in self.scripts])
        self.target = np.array([[SKILL_OF[step.kind] for step in script] for script in self.scripts])
        self.goal = np.array([[step.goal for step in script] for script in self.scripts])
        self.lasts = np.array([[step.seconds for step in script] for script in self.scripts])
        self.count, self.step_dt = n, 1.0 / 60.0
        self.end = np.full(n, -1)  # (robots,) index in OUTCOMES, -1 while under way
        self.current = np.zeros(n, dtype=int)  # (robots,) number of the command under way; after the last, of all
        self.began = np.full(shape, -1)  # (robots, commands) policy step in which each command came, -1: it did not
        self.began[:, 0] = 0
        self.switched = np.full(shape, -1)  # (robots, commands) policy step in which the jump skill took over
        self.takeoff = np.full(shape, -1)  # (robots, commands) policy step of the takeoff
        self.over = np.full(shape, -1)  # (robots, commands) policy step in which the command was over
        self.apex = np.full(shape, np.nan)  # [m] (robots, commands) largest base height of the jump
        self.offset = np.full((n, k, 2), np.nan)  # [m] from the goal to the base as walking takes over, world axes
        # after every policy step
        self.velocity: list[np.ndarray] = []  # (robots, 3) ahead, left [m/s], about z [rad/s]; NaN after the end
        self.wanted: list[np.ndarray] = []  # (robots, 3) that the policy was commanded; NaN while it does not walk
        self.counts: list[np.ndarray] = []  # (robots,) whether it counts for the tracking error: walking, SKIP later
        self.skills: list[np.ndarray] = []  # (robots,) active skill
        self.height: list[np.ndarray] = []  # [m] (robots,) of the base
        self.force: list[np.ndarray] = []  # [N] (robots, 4) on each paw
        self._skill, self._aim, self._told = np.zeros(n, dtype=int), np.zeros((n, 3)), np.zeros((n, 3))

    @property
    def block(self) -> BlockCfg | None:
        """What `Env(block=...)` needs for these scripts."""
        return BLOCK if self.onto.any() else None

    @property
    def seconds(self) -> float:
        """[s] In which every course has ended."""
        return float((self.lasts.sum(axis=1) + PATIENCE * (self.target != WALK).sum(axis=1)).max()) + 1.0

    def begin(self, env: Any) -> None:
        """Stand every robot in the default pose with its first command."""
        self.step_dt = env.step_dt
        first = np.where(self.target[:, :1] == WALK, self.goal[:, 0], 0.0)
        self._aim = first
        env.evaluation_reset(self._told, self.headings)
        self._ask(env, np.full(len(self.end), True))

    def look(self, env: Any) -> dict[str, np.ndarray]:
        """Return what is to be known of every robot, and of its last jump of each kind."""
        q, qd = env.sim.joint_q(), env.sim.joint_qd()
        seen = {
            "base_pos": q[:, :3].copy(), "base_quat": q[:, 3:7].copy(), "base_ang_vel": qd[:, 3:6].copy(),
            "base_vel": env.sim.base_velocity(), "skill": env.episodes.skill.numpy().copy(),
            "termination": env.episodes.termination.numpy().copy(),
            "force": np.linalg.norm(env.sim.paw_force.numpy(), axis=2).T,
        }  # fmt: skip
        rows = np.arange(len(q))
        kind = self.target[rows, np.minimum(self.current, self.target.shape[1] - 1)]
        for name in ("max_height", "goal", "took_off", "phase"):
            of_kind = [env.skills[skill].states.numpy()[name] for skill in (JUMP_UP, JUMP_TO)]
            seen[f"jump_{name}"] = np.array(of_kind)[np.where(kind == JUMP_TO, 1, 0), rows]
        return seen

    def follow(self, env: Any) -> bool:
        """Look at the environment after a policy step, and command and ask for what is due."""
        before, was = self.current.copy(), self._skill
        ended = super().follow(env)
        rows, running = np.arange(len(before)), self.end < 0
        at = np.minimum(self.current, self.target.shape[1] - 1)
        fresh, jumping = running & (self.current > before), self.target[rows, at] != WALK
        self._aim[fresh] = np.where(jumping[fresh, None], 0.0, self.goal[rows, at][fresh])
        waited = (len(self.skills) - self.began[rows, at]) * self.step_dt
        late = running & jumping & (self._skill == WALK) & (waited >= NUDGE_AFTER)
        nudged = np.where((np.mod(waited, NUDGE_AFTER) < NUDGE_FOR)[:, None], NUDGE, 0.0)
        self._aim[late] = nudged[late]
        told = self._told + np.clip(self._aim - self._told, -SLEW * self.step_dt, SLEW * self.step_dt)
        told[self._skill != WALK] = 0.0
        changed = (self._skill == WALK) & ((told != self._told).any(axis=1) | (was != WALK))
        self._told = told
        if changed.any():
            env.command(told, changed)
        self._ask(env, fresh)
        if self.onto.any():
            self._place_blocks(env)
        return ended

    def _place_blocks(self, env: Any) -> None:
        """Put a block under the goal of every robot that begins to jump onto one."""
        begins = np.flatnonzero((self.onto & (self.switched == len(self.skills))).any(axis=1))
        if len(begins):
            goals = env.skills[JUMP_TO].states.numpy()["goal"][begins, :2]
            env.sim.solver.place_blocks(goals, begins.tolist())

    def _ask(self, env: Any, worlds: np.ndarray) -> None:
        """Ask for the jumps that are the commands of some robots."""
        rows, at = np.arange(len(worlds)), np.minimum(self.current, self.target.shape[1] - 1)
        for skill in (JUMP_UP, JUMP_TO):
            asked = worlds & (self.target[rows, at] == skill)
            if asked.any():
                delay = np.full((len(rows), 1), round(SQUAT / self.step_dt))
                env.requested_task(skill, asked, np.concatenate([self.goal[rows, at], delay], axis=1))

    def update(self, arrays: dict[str, np.ndarray], step_dt: float) -> bool:
        """Take in a policy step; return whether all courses have ended."""
        self.step_dt, last = step_dt, self.target.shape[1] - 1
        skill, was, step = arrays["skill"], self._skill, len(self.skills) + 1
        running = self.end < 0
        self._keep(arrays, running, was, step)
        fell = running & (arrays["termination"] >= 0)
        self.end[fell] = arrays["termination"][fell]
        row = np.flatnonzero(running & ~fell)
        at = (row, self.current[row])
        kind, since = self.target[at], step - self.began[at]
        jumps = kind != WALK
        entered = jumps & (skill[row] == kind) & (was[row] != kind)
        self.switched[row[entered], self.current[row[entered]]] = step
        left = jumps & (skill[row] != kind) & (was[row] == kind)
        took_off = jumps & (was[row] == kind) & (arrays["jump_took_off"][row] == 1)
        self.takeoff[row[took_off], self.current[row[took_off]]] = step
        for name, values in (
            ("apex", arrays["jump_max_height"]),
            ("offset", arrays["base_pos"][:, :2] - arrays["jump_goal"][:, :2]),
        ):
            getattr(self, name)[row[left], self.current[row[left]]] = values[row[left]]
        walked = ~jumps & (since >= np.round(self.lasts[at] / step_dt))
        finished = walked | left
        no_jump = left & (self.takeoff[at] < 0)
        stuck = jumps & ~left & (since >= round(PATIENCE / step_dt))
        self.over[row[finished], self.current[row[finished]]] = step
        self.end[row[stuck | no_jump]] = STUCK
        self.end[row[finished & ~no_jump & (self.current[row] == last)]] = DONE
        self.current[row[finished]] += 1
        fresh = row[finished & (self.current[row] <= last)]
        self.began[fresh, self.current[fresh]] = step
        self._skill = skill
        return bool((self.end >= 0).all())

    def _keep(self, arrays: dict[str, np.ndarray], running: np.ndarray, was: np.ndarray, step: int) -> None:
        """Keep the histories of a policy step, in which the skills of before it were active."""
        rows = np.arange(len(running))
        at = np.minimum(self.current, self.target.shape[1] - 1)
        alive, walking = running[:, None], (was == WALK)[:, None]
        self.velocity.append(np.where(alive, body_velocity(arrays), np.nan).astype(np.float32))
        self.wanted.append(np.where(alive & walking, self._told, np.nan).astype(np.float32))
        settled = step - self.began[rows, at] > round(SKIP / self.step_dt)
        self.counts.append(running & walking[:, 0] & settled & (self.target[rows, at] == WALK))
        self.skills.append(was.copy())
        self.height.append(arrays["base_pos"][:, 2].copy())
        self.force.append(arrays["force"].astype(np.float32))

    @property
    def fallen(self) -> np.ndarray:
        """Whether each robot fell."""
        return (self.end >= 0) & (self.end < STUCK)

    @property
    def outcomes(self) -> np.ndarray:
        """What became of each robot."""
        return np.array([*OUTCOMES, "under_way"])[self.end]

    @property
    def apex_error(self) -> np.ndarray:
        """[m] (robots, commands) Apex less commanded height; not a number for what is no jump up, or was not made."""
        return np.where(self.target == JUMP_UP, self.apex - self.goal[..., 2], np.nan)

    @property
    def landing_error(self) -> np.ndarray:
        """[m] (robots, commands) Distance from the goal as walking takes over; not a number for other commands."""
        return np.where(self.target == JUMP_TO, np.linalg.norm(self.offset, axis=-1), np.nan)

    @property
    def on_goal(self) -> np.ndarray:
        """(robots, commands) Whether a command was carried out, jumps within SETTLED of their goal."""
        off = np.where(self.target == JUMP_UP, np.abs(self.apex_error), self.landing_error)
        return (self.over >= 0) & ((self.target == WALK) | (np.nan_to_num(off, nan=np.inf) <= SETTLED))

    def columns(self) -> dict[str, list]:
        """Return for each robot how it ended, how many commands it carried out, and its errors."""
        apex, landing = (np.abs(each) for each in (self.apex_error, self.landing_error))
        worst = {"apex_error_m": _worst(apex), "landing_error_m": _worst(landing)}
        done = {"end": self.outcomes.tolist(), "commands_done": (self.over >= 0).sum(axis=1).tolist()}
        return done | {name: finite(values) for name, values in worst.items()}

    def series(self, worlds: Sequence[int]) -> dict[str, float]:
        """Return velocity and command, height and active skill."""
        series = velocity_series(self.velocity[-1], np.nan_to_num(self.wanted[-1]), worlds)
        for world in worlds:
            series[f"height/base of {world} [m]"] = float(self.height[-1][world])
            series[f"skill/of {world} [1]"] = float(self.skills[-1][world])
        return series

    def notes(self, worlds: Sequence[int]) -> dict[str, Any]:
        """Return the scripts."""
        return {"scripts": [[[step.kind, *step.values] for step in self.scripts[world]] for world in worlds]}


def _worst(values: np.ndarray) -> np.ndarray:
    """Return the largest number of each row, not a number where there is none."""
    known = np.isfinite(values)
    return np.where(known.any(axis=1), np.where(known, values, -np.inf).max(axis=1), np.nan)


def course_metrics(course: Course) -> Metrics:
    """Return the metrics of all robots together.

    `success_rate` is the share of robots that made every command without a fall, whatever their errors;
    `on_goal_rate` of those whose jumps came within 0.1 m of their goals besides. Errors are means over the jumps that
    were made. Tracking errors leave out the first second after each command.
    """
    robots, up, to = len(course.end), course.target == JUMP_UP, course.target == JUMP_TO
    jumps = up | to
    made = jumps & (course.takeoff >= 0)
    apex, landing = np.abs(course.apex_error), course.landing_error
    waited = (course.takeoff - course.began)[made] * course.step_dt
    stopped = (course.switched - course.began)[jumps & (course.switched >= 0)] * course.step_dt
    done = course.outcomes == "done"
    ripple, step = handover_forces(course)
    return {
        "robots": robots,
        "success_rate": float(done.mean()),
        "on_goal_rate": float((done & course.on_goal.all(axis=1)).mean()),
        "fall_rate": float(course.fallen.mean()),
        "stuck_rate": float((course.end == STUCK).mean()),
        **rmse_metrics(tracking_error(course)),
        "apex_error_m": mean(apex),
        "max_apex_error_m": largest(apex),
        "mean_signed_apex_error_m": mean(course.apex_error),
        "landing_error_m": mean(landing),
        "max_landing_error_m": largest(landing),
        "jumps_asked": int((jumps & (course.began >= 0)).sum()),
        "jumps_made": int(made.sum()),
        "command_to_takeoff_s": mean(waited),
        "max_command_to_takeoff_s": largest(waited),
        "command_to_jump_skill_s": mean(stopped),
        "max_command_to_jump_skill_s": largest(stopped),
        "handover_force_ripple_n": mean(ripple),
        "max_handover_force_ripple_n": largest(ripple),
        "handover_force_step_n": mean(step),
        "max_handover_force_step_n": largest(step),
    } | failures(course.outcomes[~done])  # fmt: skip


def tracking_error(course: Course) -> np.ndarray:
    """Return velocity less command, (steps, robots, 3), NaN where it does not count."""
    error = np.array(course.velocity, dtype=float) - np.array(course.wanted, dtype=float)
    error[~np.array(course.counts)] = np.nan
    return error


def handover_forces(course: Course) -> tuple[np.ndarray, np.ndarray]:
    """Return how the force on a paw varies before each handover to a jump [N], and by how much it steps there.

    Of the paw where it does so most: peak to peak over the last QUIET seconds of the stand before it; and from the last
    policy step before it to the first after it.
    """
    force, ripples, steps = np.array(course.force, dtype=float), [], []
    window = round(QUIET / course.step_dt)
    for world, command in zip(*np.nonzero(course.switched >= 0), strict=True):
        last = course.switched[world, command]  # the last policy step of walking, counted from 1
        part = force[max(last - window, 0) : last, world]
        ripples.append(np.ptp(part, axis=0).max())
        if last < len(force):
            steps.append(np.abs(force[last, world] - force[last - 1, world]).max())
    return np.array(ripples), np.array(steps)


def active_spans(course: Course, world: int) -> list[tuple[int, float, float]]:
    """Return the skills of a robot one after the other: index, beginning and end [s]."""
    skills = np.array(course.skills)[:, world]
    edges = [0, *(np.flatnonzero(np.diff(skills)) + 1).tolist(), len(skills)]
    return [(int(skills[a]), a * course.step_dt, b * course.step_dt) for a, b in pairwise(edges)]


def plot_course(path: Path, course: Course, world: int, title: str = "") -> None:
    """Draw velocities and commands, height and active skill of a robot over time."""
    with figure(path, 5, 1, figsize=(10, 9), sharex=True) as axes:
        time = course.step_dt * np.arange(1, len(course.skills) + 1)
        velocity, wanted = (np.array(values)[:, world] for values in (course.velocity, course.wanted))
        labels = ("vx [m/s]", "vy [m/s]", "yaw rate [rad/s]")
        for i, label in enumerate(labels):
            axes[i].plot(time, velocity[:, i], color="tab:blue", linewidth=0.9, label="actual")
            axes[i].plot(time, wanted[:, i], color="tab:red", linewidth=1.2, label="commanded")
            axes[i].set(ylabel=label, ylim=(-1.6, 1.6))
        axes[0].legend(loc="upper right", ncols=2)
        axes[3].plot(time, np.array(course.height)[:, world], color="tab:blue", linewidth=0.9)
        axes[3].set(ylabel="height [m]")
        axes[4].step(time, np.array(course.skills)[:, world], where="pre", color="black", linewidth=1.0)
        axes[4].set(xlabel="time [s]", ylabel="skill", yticks=list(NAMES), yticklabels=list(NAMES.values()))
        for skill, begin, end in active_spans(course, world):
            for axis in axes:
                axis.axvspan(begin, end, color=COLOURS[skill], alpha=0.15, linewidth=0.0)
        axes[0].set_title(title)
