"""Evaluation of courses: one robot per world executes a script of walks and jumps by switching between skills.

Before a jump the robot is commanded to stand, and the jump is requested with its goal. The jump skill takes over once
the robot is at rest, and later returns control to walking (`kernels.skills.handovers`). A robot that does not come to
rest walks a few steps. Commanded velocities change at a limited rate.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, cast

import numpy as np

from jumper_warp.evaluation import velocities
from jumper_warp.evaluation.jumps import updated_apex
from jumper_warp.evaluation.log import EvaluationLog, ended_by, listed
from jumper_warp.evaluation.scripts import ScriptStep
from jumper_warp.evaluation.skills import JUMP_TO, JUMP_UP, WALK
from jumper_warp.evaluation.trained import warn_beyond_training
from jumper_warp.robot.grounds import BlockCfg
from jumper_warp.tasks.cfg import TaskCfg
from jumper_warp.tasks.switching import FALLS
from jumper_warp.utils.errors import InputError
from jumper_warp.utils.files import Json
from jumper_warp.utils.kernels import records
from jumper_warp.utils.metrics import Metrics, largest, mean, rate, rmse
from jumper_warp.viz.plots import figure
from jumper_warp.viz.style import ACTUAL_COLOR

if TYPE_CHECKING:
    from jumper_warp.envs.env import Env
    from jumper_warp.sim.solver import SolverJumper

SKILLS = {"walk": WALK, "stand": WALK, "jump_up": JUMP_UP, "jump_to": JUMP_TO, "jump_onto": JUMP_TO}
"""Skill of each kind of command."""
BLOCK = BlockCfg(center=(1.0e3, 1.0e3), half=(0.55, 0.55), height=0.05, mass=10.0, friction=0.4)
"""Block to jump onto, initially 1 km away on both axes; it is moved under the goal when the jump skill takes over."""
SQUAT_TIME = 0.5  # [s] Time from the jump skill's takeover, when it squats, to its command
NUDGE_AFTER, NUDGE_TIME = (2.0, 0.5)  # [s] Period and duration of the steps of a robot that waits for its jump
NUDGE = (0.25, 0.0, 0.0)  # [m/s], [rad/s] Commanded velocity of these steps
JUMP_TIMEOUT = 15.0  # [s] Time after its request at which an unfinished jump has failed
STUCK, DONE = len(FALLS), len(FALLS) + 1  # Indices in OUTCOMES; smaller ones are falls
OUTCOMES = (*(term.name for term in FALLS), "stuck", "done")
GOAL_TOLERANCE = 0.1  # [m] Largest error of a jump that is on its goal
FORCE_WINDOW = 0.2  # [s] Time before a handover to a jump over which paw forces are evaluated
COLOURS = {JUMP_UP: "C4", JUMP_TO: "C3"}  # Shades of plots, by skill
NAMES = ("walk", "jump up", "jump to")  # By skill


@dataclass
class CourseLog(EvaluationLog):
    """Log of one course (script of walks and jumps) per robot; samples after the end of a course are NaN or ignored."""

    scripts: Sequence[Sequence[ScriptStep]]  # One script per robot, all with the same number of commands
    headings: np.ndarray | float = 0.0  # [rad] (robots,) Headings at the start, or one for all
    row_name = "robot"
    spacing = 2.0

    def __post_init__(self) -> None:
        """Allocate the log of all robots. Raises InputError: scripts are empty or of different lengths."""
        lengths = {len(script) for script in self.scripts}
        if len(lengths) != 1 or 0 in lengths:
            raise InputError(f"scripts must have equal, positive lengths, got {sorted(lengths)} commands")
        n, k = shape = len(self.scripts), lengths.pop()
        # (robots, commands) each: whether the command is jump_onto, its skill, goal (..., 3) and time [s]
        self.onto_block = np.array([[step.kind == "jump_onto" for step in script] for script in self.scripts])
        self.target_skill = np.array([[SKILLS[step.kind] for step in script] for script in self.scripts])
        self.goal = np.array([[step.goal for step in script] for script in self.scripts])
        self.durations = np.array([[step.seconds for step in script] for script in self.scripts])
        self.count = n
        self.step_dt = 1.0 / 60.0
        self.end = np.full(n, -1)  # (robots,) index in OUTCOMES, -1 until the end
        self.current = np.zeros(n, dtype=int)  # (robots,) index of the current command
        self.start_step = np.full(shape, -1)  # (robots, commands) policy step in which a command began, or -1
        self.start_step[:, 0] = 0
        self.switch_step = np.full(shape, -1)  # (robots, commands) policy step in which the jump skill took over
        self.takeoff_step = np.full(shape, -1)  # (robots, commands) policy step of the takeoff
        self.finish_step = np.full(shape, -1)  # (robots, commands) policy step in which the command finished
        self.apex = np.full(
            shape, np.nan
        )  # [m] (robots, commands) apex above the goal's ground so far, see `updated_apex`
        self.offset = np.full((n, k, 2), np.nan)  # [m] from the goal to the base as walking takes over, world axes
        self.goal_world = np.full((n, k, 2), np.nan)  # [m] of jumps to a place whose skill took over, world axes
        # one array per policy step
        self.velocity: list[np.ndarray] = []  # (robots, 3) ahead, left [m/s], about z [rad/s]; NaN after the end
        self.commands: list[np.ndarray] = []  # (robots, 3) commanded; NaN while it does not walk
        self.is_tracked: list[np.ndarray] = []  # (robots,) whether it walks, SETTLING_TIME after a command
        self.skills: list[np.ndarray] = []  # (robots,) active skill
        self.height: list[np.ndarray] = []  # [m] (robots,) of the base
        self.force: list[np.ndarray] = []  # [N] (robots, 4) on each paw
        self._skill = np.zeros(n, dtype=int)
        self._target_velocity = np.zeros((n, 3))
        self._command = np.zeros((n, 3))

    @property
    def _at(self) -> np.ndarray:
        """Index in its script of each robot's current command, (robots,); after the end that of its last command."""
        return np.minimum(self.current, self.target_skill.shape[1] - 1)

    @property
    def block(self) -> BlockCfg | None:
        """Block that the scripts' jumps land on, for `Env(block=...)`; None if no command is a jump onto it."""
        return BLOCK if self.onto_block.any() else None

    @property
    def seconds(self) -> float:
        """Simulated time [s] after which all courses end at the latest."""
        return float((self.durations.sum(axis=1) + JUMP_TIMEOUT * (self.target_skill != WALK).sum(axis=1)).max()) + 1.0

    def warn_beyond_training(self, tasks: Sequence[TaskCfg]) -> None:
        """Print a warning for each skill whose commands exceed those of its training; tasks: one per skill."""
        for skill, task in enumerate(tasks):
            if (chosen := self.target_skill == skill).any():
                warn_beyond_training(task, self.goal[chosen])

    def begin(self, env: Env) -> None:
        """Reset every robot to the default pose at rest, and start its first command."""
        self.step_dt = env.step_dt
        first = np.where(self.target_skill[:, :1] == WALK, self.goal[:, 0], 0.0)
        self._target_velocity = first
        env.evaluation_reset(self._command, self.headings)
        self._request_jumps(env, np.full(len(self.end), True))

    def read_env(self, env: Env) -> dict[str, np.ndarray]:
        """Return by name what `update` records, (robots, ...): base, skill, termination, paw forces [N], jump state.

        Base position [m], quaternion (xyzw), velocity [m/s] and angular velocity [rad/s] are in world axes. `jump_`
        arrays are fields of the current command's jump skill, or of JUMP_UP while the robot walks.
        """
        q = env.sim.joint_q()
        qd = env.sim.joint_qd()
        arrays = {
            "base_pos": q[:, :3].copy(), "base_quat": q[:, 3:7].copy(), "base_ang_vel": qd[:, 3:6].copy(),
            "base_vel": env.sim.base_velocity(), "skill": env.episodes.skill.numpy().copy(),
            "termination": env.episodes.termination.numpy().copy(),
            "force": np.linalg.norm(env.sim.paw_force.numpy(), axis=2).T,
        }  # fmt: skip
        rows = np.arange(len(q))
        kind = self.target_skill[rows, self._at]
        for name in ("goal", "goal_ground", "phase", "took_off", "touched_down"):
            by_skill = [records(env.skills[skill].states)[name] for skill in (JUMP_UP, JUMP_TO)]
            arrays[f"jump_{name}"] = np.array(by_skill)[np.where(kind == JUMP_TO, 1, 0), rows]
        return arrays

    def record_step(self, env: Env) -> bool:
        """Record a policy step, then send each robot its next command if it is due; return whether all are done."""
        before = self.current.copy()
        previous = self._skill
        ended = super().record_step(env)
        rows = np.arange(len(before))
        at = self._at
        running = self.end < 0
        started = running & (self.current > before)
        jumping = self.target_skill[rows, at] != WALK
        self._target_velocity[started] = np.where(jumping[started, None], 0.0, self.goal[rows, at][started])
        waited = (len(self.skills) - self.start_step[rows, at]) * self.step_dt
        waits = running & jumping & (self._skill == WALK) & (waited >= NUDGE_AFTER)
        nudged = np.where((np.mod(waited, NUDGE_AFTER) < NUDGE_TIME)[:, None], NUDGE, 0.0)
        self._target_velocity[waits] = nudged[waits]
        step = velocities.SLEW_RATE * self.step_dt
        command = self._command + np.clip(self._target_velocity - self._command, -step, step)
        command[self._skill != WALK] = 0.0
        changed = (self._skill == WALK) & ((command != self._command).any(axis=1) | (previous != WALK))
        self._command = command
        if changed.any():
            env.command(command, changed)
        self._request_jumps(env, started)
        if self.onto_block.any():
            self._place_blocks(env)
        return ended

    def _place_blocks(self, env: Env) -> None:
        """Move the block under the goal of every robot that begins to jump onto one."""
        begins = np.flatnonzero((self.onto_block & (self.switch_step == len(self.skills))).any(axis=1))
        if len(begins):
            goals = records(env.skills[JUMP_TO].states)["goal"][begins, :2]
            cast("SolverJumper", env.sim.solver).place_blocks(goals, begins.tolist())

    def _request_jumps(self, env: Env, worlds: np.ndarray) -> None:
        """Request the jump from those robots in `worlds`, (robots,) bool, whose current command is a jump."""
        rows = np.arange(len(worlds))
        at = self._at
        for skill in (JUMP_UP, JUMP_TO):
            requested = worlds & (self.target_skill[rows, at] == skill)
            if requested.any():
                delay = np.full((len(rows), 1), round(SQUAT_TIME / self.step_dt))
                env.request(skill, requested, np.concatenate([self.goal[rows, at], delay], axis=1))

    def update(self, arrays: dict[str, np.ndarray], step_dt: float) -> bool:
        """Record a policy step from the arrays of `read_env`; return whether all courses have ended.

        A walk finishes after its time, a jump when its skill hands over to another. A jump without a takeoff, or
        unfinished JUMP_TIMEOUT seconds after its request, ends the course as STUCK.
        """
        self.step_dt = step_dt
        last = self.target_skill.shape[1] - 1
        skill = arrays["skill"]
        previous = self._skill
        step = len(self.skills) + 1
        running = self.end < 0
        self._append_history(arrays, running, previous, step)
        fell = running & (arrays["termination"] >= 0)
        self.end[fell] = arrays["termination"][fell]
        row = np.flatnonzero(running & ~fell)
        at = (row, self.current[row])
        kind = self.target_skill[at]
        since = step - self.start_step[at]
        jumps = kind != WALK
        entered = jumps & (skill[row] == kind) & (previous[row] != kind)
        self.switch_step[row[entered], self.current[row[entered]]] = step
        placed = row[entered & (kind == JUMP_TO)]
        self.goal_world[placed, self.current[placed]] = arrays["jump_goal"][placed, :2]
        left = jumps & (skill[row] != kind) & (previous[row] == kind)
        took_off = jumps & (previous[row] == kind) & (arrays["jump_took_off"][row] == 1)
        self.takeoff_step[row[took_off], self.current[row[took_off]]] = step
        jumping = row[jumps & (previous[row] == kind)]
        jump = {name: arrays[f"jump_{name}"][jumping] for name in ("phase", "took_off", "touched_down")}
        jump["base_pos"] = arrays["base_pos"][jumping] - arrays["jump_goal_ground"][jumping, None]
        now = (jumping, self.current[jumping])
        self.apex[now] = updated_apex(self.apex[now], jump)
        offset = (arrays["base_pos"] - arrays["jump_goal"])[row[left], :2]
        self.offset[row[left], self.current[row[left]]] = offset
        walked = ~jumps & (since >= np.round(self.durations[at] / step_dt))
        finished = walked | left
        no_jump = left & (self.takeoff_step[at] < 0)
        stuck = jumps & ~left & (since >= round(JUMP_TIMEOUT / step_dt))
        self.finish_step[row[finished], self.current[row[finished]]] = step
        self.end[row[stuck | no_jump]] = STUCK
        self.end[row[finished & ~no_jump & (self.current[row] == last)]] = DONE
        self.current[row[finished]] += 1
        fresh = row[finished & (self.current[row] <= last)]
        self.start_step[fresh, self.current[fresh]] = step
        self._skill = skill
        return bool((self.end >= 0).all())

    def _append_history(
        self, arrays: dict[str, np.ndarray], running: np.ndarray, previous: np.ndarray, step: int
    ) -> None:
        """Append a policy step to the recorded histories.

        arrays: those of `read_env`; running: (robots,) whether the course had not ended; previous: (robots,) skill
        that was active in the step; step: its number, from 1.
        """
        rows = np.arange(len(running))
        at = self._at
        alive = running[:, None]
        walking = (previous == WALK)[:, None]
        self.velocity.append(np.where(alive, velocities.body_velocity(arrays), np.nan).astype(np.float32))
        self.commands.append(np.where(alive & walking, self._command, np.nan).astype(np.float32))
        settled = step - self.start_step[rows, at] > round(velocities.SETTLING_TIME / self.step_dt)
        self.is_tracked.append(running & walking[:, 0] & settled & (self.target_skill[rows, at] == WALK))
        self.skills.append(previous.copy())
        self.height.append(arrays["base_pos"][:, 2].copy())
        self.force.append(arrays["force"].astype(np.float32))

    @property
    def fallen(self) -> np.ndarray:
        """Whether each robot fell, (robots,)."""
        return (self.end >= 0) & (self.end < STUCK)

    @property
    def outcomes(self) -> np.ndarray:
        """Outcome of each robot's course, (robots,): one of OUTCOMES or "under_way"."""
        return np.array([*OUTCOMES, "under_way"])[self.end]

    @property
    def apex_error(self) -> np.ndarray:
        """Apex minus commanded height [m], (robots, commands); NaN unless the command is a finished jump up."""
        finished = (self.target_skill == JUMP_UP) & (self.finish_step >= 0)
        return np.where(finished, self.apex - self.goal[..., 2], np.nan)

    @property
    def landing_error(self) -> np.ndarray:
        """Distance from base to goal as walking takes over from a jump to a place [m], (robots, commands); else NaN."""
        return np.where(self.target_skill == JUMP_TO, np.linalg.norm(self.offset, axis=-1), np.nan)

    @property
    def on_goal(self) -> np.ndarray:
        """Whether each command was completed, for a jump also within GOAL_TOLERANCE of its goal, (robots, commands)."""
        error = np.where(self.target_skill == JUMP_UP, np.abs(self.apex_error), self.landing_error)
        near = np.nan_to_num(error, nan=np.inf) <= GOAL_TOLERANCE
        return (self.finish_step >= 0) & ((self.target_skill == WALK) | near)

    def columns(self) -> dict[str, list]:
        """Return one value per robot by name: outcome, number of completed commands, largest errors of its jumps [m].

        Keys: end (outcome), commands_done, apex_error_m, landing_error_m.
        """
        worst = {"apex_error_m": _row_max(np.abs(self.apex_error)), "landing_error_m": _row_max(self.landing_error)}
        return listed({"end": self.outcomes, "commands_done": (self.finish_step >= 0).sum(axis=1)} | worst)

    def series(self) -> dict[str, np.ndarray]:
        """Return values to plot: the current velocity, command and base height [m] of all robots."""
        series = velocities.velocity_series(self.velocity[-1], self.marks()["commands"])
        return series | {"height/base, {} [m]": self.height[-1]}

    def states(self) -> dict[str, np.ndarray]:
        """Return the name of the skill that each robot used in the last policy step, for recordings."""
        return {"skill/{}": np.array(NAMES)[self.skills[-1]]}

    def marks(self) -> dict[str, np.ndarray]:
        """Return the markers of a recording: goals of all robots' jumps, NaN if none, and commanded velocities."""
        goals = np.pad(self.goal_world, ((0, 0), (0, 0), (0, 1)))
        return {"goals": goals, "commands": np.nan_to_num(self.commands[-1])}

    def notes(self, worlds: Sequence[int]) -> Json:
        """Return metadata of a recording: the scripts of some robots, key `scripts`, lists of [kind, *values]."""
        return {"scripts": [[[step.kind, *step.values] for step in self.scripts[world]] for world in worlds]}


def _row_max(values: np.ndarray) -> np.ndarray:
    """Return the largest finite value in each row of a matrix (rows, columns), NaN for rows without one."""
    known = np.isfinite(values)
    return np.where(known.any(axis=1), np.where(known, values, -np.inf).max(axis=1), np.nan)


def course_metrics(course: CourseLog) -> Metrics:
    """Return rates of finished courses and falls, errors of jumps and tracking, and forces at switches to a jump.

    `finished_rate` is the fraction of robots that finished every command without a fall; it ignores errors.
    `finished_on_goal_rate` also requires all jumps within 0.1 m of their goals. Tracking errors are those of slewed
    commands, without the first second after each.
    """
    jumps = course.target_skill != WALK
    made = jumps & (course.takeoff_step >= 0)
    switched = jumps & (course.switch_step >= 0)
    finished = course.outcomes == "done"
    error = np.array(course.velocity, dtype=float) - np.array(course.commands, dtype=float)
    error[~np.array(course.is_tracked)] = np.nan
    squares = velocities.square_sums(error)
    metrics = {
        "finished_rate": rate(finished, "robots"),
        "finished_on_goal_rate": rate(finished & course.on_goal.all(axis=1), "robots"),
        "fall_rate": rate(course.fallen, "robots"),
        **ended_by(course.outcomes, "robots"),
        "jump_made_rate": rate(made[jumps & (course.start_step >= 0)], "requested jumps"),
        "apex_error_abs_mean_m": mean(np.abs(course.apex_error), "finished jumps up"),
        "apex_error_signed_mean_m": mean(course.apex_error, "finished jumps up"),
        "apex_error_abs_max_m": largest(np.abs(course.apex_error), "finished jumps up"),
        "goal_distance_at_handover_mean_m": mean(course.landing_error, "finished jumps to places"),
        "goal_distance_at_handover_max_m": largest(course.landing_error, "finished jumps to places"),
    }
    for i, (axis, unit) in enumerate(zip(velocities.AXES, velocities.UNITS, strict=True)):
        metrics[f"settled_slewed_rmse_{axis}_{unit}"] = rmse(squares[:, i], "robots")
    ripple, step = handover_forces(course)
    takeoff, switch = (course.step_dt * (s - course.start_step) for s in (course.takeoff_step, course.switch_step))
    for name, values, over in (
        ("command_to_takeoff_{}_s", takeoff[made], "made jumps"),
        ("command_to_jump_skill_{}_s", switch[switched], "handovers"),
        ("handover_force_ripple_{}_n", ripple, "handovers"),
        ("handover_force_step_{}_n", step, "handovers"),
    ):
        metrics |= {name.format("mean"): mean(values, over), name.format("max"): largest(values, over)}
    return metrics


def handover_forces(course: CourseLog) -> tuple[np.ndarray, np.ndarray]:
    """Return the variation of paw forces before each handover from walking to a jump skill, and their change at it [N].

    Variation: peak-to-peak force over the last FORCE_WINDOW seconds before the handover, (handovers,); change: between
    the policy steps before and after it, without a handover in the last step. Each is the maximum over the four paws.
    """
    force = np.array(course.force, dtype=float)
    ripples = []
    steps = []
    window = round(FORCE_WINDOW / course.step_dt)
    for world, command in zip(*np.nonzero(course.switch_step >= 0), strict=True):
        last = course.switch_step[world, command]  # the last policy step of walking, counted from 1
        part = force[max(last - window, 0) : last, world]
        ripples.append(np.ptp(part, axis=0).max())
        if last < len(force):
            steps.append(np.abs(force[last, world] - force[last - 1, world]).max())
    return np.array(ripples), np.array(steps)


def active_spans(course: CourseLog, world: int) -> list[tuple[int, float, float]]:
    """Return the time spans in which a robot used each skill, as tuples (skill, begin [s], end [s]) in order of time.

    skill: WALK, JUMP_UP or JUMP_TO.
    """
    skills = np.array(course.skills)[:, world]
    edges = [0, *(np.flatnonzero(np.diff(skills)) + 1).tolist(), len(skills)]
    return [(int(skills[a]), a * course.step_dt, b * course.step_dt) for a, b in pairwise(edges)]


def plot_course(path: Path, course: CourseLog, world: int, conditions: str = "") -> None:
    """Plot a robot's velocities with commands, and base height, over time; jumps are shaded; world: its index."""
    settings = {"figsize": (10.0, 9.0), "sharex": True, "title": "Walk and jump", "conditions": conditions}
    with figure(path, 4, 1, **settings) as axes:
        time = course.step_dt * np.arange(1, len(course.skills) + 1)
        velocity, command = (np.array(values)[:, world] for values in (course.velocity, course.commands))
        for i, label in enumerate(("ahead [m/s]", "to the left [m/s]", "yaw rate [rad/s]")):
            axes[i].plot(time, velocity[:, i], color=ACTUAL_COLOR, linewidth=0.9, label="actual")
            axes[i].plot(time, command[:, i], color=ACTUAL_COLOR, linestyle="--", label="commanded")
            axes[i].set(ylabel=label, ylim=(-1.6, 1.6))
        axes[3].plot(time, np.array(course.height)[:, world], color=ACTUAL_COLOR)
        axes[3].set(xlabel="time [s]", ylabel="base height [m]")
        for skill, begin, end in active_spans(course, world):
            for axis in axes if skill in COLOURS else ():
                axis.axvspan(begin, end, color=COLOURS[skill], alpha=0.2, label=NAMES[skill])
