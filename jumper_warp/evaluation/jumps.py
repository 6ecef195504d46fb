"""Outcomes of jumps, each from its command to rest after landing, and the base class of their logs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import TYPE_CHECKING

import numpy as np

from jumper_warp.evaluation.log import COLLIDED, DIVERGED, FALLS, NO_END, SUCCESS, EvaluationLog, check, listed
from jumper_warp.sim.simulation import motor_values
from jumper_warp.utils.arrays import real_array
from jumper_warp.utils.files import Json
from jumper_warp.utils.rotations import turn_plane, yaw_of

if TYPE_CHECKING:
    from jumper_warp.envs.env import Env

PHASES = ("stance", "flight", "landed")  # Names of the values of a jump's phase
STANCE, LANDED = 0, 2  # Values of the jump's phase before takeoff and after touchdown
TOLERANCE = 0.1  # [m] Largest distance from the goal of a jump that reaches it
REST_SPEED = 0.1  # [m/s] Speed of the base's centre of mass below which the robot is at rest
HOP_TIME = 0.05  # [s] Least time without any paw on the ground of a hop after touchdown, and of a paw of a step
TIME_EPS = 1.0e-6  # [s] Tolerance for rounding of sums of steps
REST_TIME = 1.0  # [s] Time after touchdown at which the robot should be at rest
DELAY = 0.5  # [s] Time until the first jump is commanded
TAKEOFF_SPEED = 0.25  # [m/s] Upward speed of the base, with no paw down, of a second takeoff (authors' configuration)
NOT_BEGUN = "not_begun"  # End of a jump that was not commanded, because an earlier jump failed


def random_headings(count: int, seed: int) -> np.ndarray:
    """Return uniformly random headings [rad] in -pi..pi, (count,)."""
    return np.random.default_rng(seed).uniform(-np.pi, np.pi, count)


def paw_arrays(env: Env) -> dict[str, np.ndarray]:
    """Return by name whether each paw touches the ground, the paws' positions [m], and the base's upward speed [m/s].

    `paws_down` (num_envs, 4): whether they touch ground; `paw_pos` (num_envs, 4, 2): centres x, y [m], world; `up`
    (num_envs,) [m/s].
    """
    force = np.linalg.norm(env.sim.paw_force.numpy(), axis=2)
    pos = env.robot.paw_pos.numpy().transpose(1, 0, 2)[..., :2].copy()
    return {"paws_down": (force > env.task.contact_force).T, "paw_pos": pos, "up": env.sim.base_velocity()[:, 2]}


def updated_apex(apex: np.ndarray, jump: dict[str, np.ndarray]) -> np.ndarray:
    """Return the apexes [m] of n jumps, (n,), updated with the base heights of a policy step.

    An apex is the largest base height in flight so far; before takeoff it is the current height, after touchdown it
    stays. jump: arrays (n, ...) of the step.
    """
    begins = (jump["phase"] == STANCE) | (jump["took_off"] == 1)
    flies = (jump["phase"] != LANDED) | (jump["touched_down"] == 1)
    height = jump["base_pos"][:, 2]
    return np.where(begins, height, np.where(flies, np.fmax(apex, height), apex))


def jump_commands(goals: np.ndarray, delay: np.ndarray | float, step_dt: float) -> np.ndarray:
    """Return jump commands for an environment, (num_envs, 4): goal x, y, z [m], and policy step of the command.

    goals [m]: (num_envs, 3), landing x, y relative to start and heading, and base height at the apex, 0 for any;
    delay [s]: time until the jump is commanded, (num_envs,) or one for all.
    """
    steps = np.broadcast_to(np.round(np.asarray(delay) / step_dt), len(goals))
    return np.concatenate([goals, steps[:, None]], axis=1).astype(np.float32)


@dataclass(frozen=True)
class JumpOutcome:
    """Outcomes of simulated jumps: events such as falls, and errors; arrays of shape (num_envs, jumps in a row)."""

    commanded: np.ndarray  # Whether the jump was commanded
    to_height: np.ndarray  # Whether the goal is an apex height, else a place
    early: np.ndarray  # Whether the robot took off before the command
    touched_down: np.ndarray  # Whether it touched down after a takeoff
    reached: np.ndarray  # Whether the apex, or the base at rest, was within TOLERANCE of the goal
    landed: np.ndarray  # Whether it touched down on its paws and nothing else touched anything until the end
    at_rest: np.ndarray  # Whether it landed, and its speed was below REST_SPEED one second after touchdown
    success: np.ndarray  # Whether it jumped on command, reached the goal, landed and came to rest
    still: np.ndarray  # Whether it landed without lifting a paw again for HOP_TIME or longer
    hopped: np.ndarray  # Whether all paws were off the ground for longer than HOP_TIME after touchdown
    took_off_again: np.ndarray  # Whether it rose again with no paw on the ground
    fell: np.ndarray  # Whether the base or a link other than a paw touched something, or the simulation diverged
    collided: np.ndarray  # Whether it fell by a link that touched something
    diverged: np.ndarray  # Whether the simulation diverged
    missed: np.ndarray  # Whether it landed without reaching the goal
    no_jump: np.ndarray  # Whether it did not take off in time
    apex_m: np.ndarray  # Largest base height from takeoff to touchdown; without a takeoff the last one
    apex_error_m: np.ndarray  # Apex minus commanded height
    distance_at_end_m: np.ndarray  # From goal to base, horizontal, when the jump ended or failed
    distance_at_touchdown_m: np.ndarray  # From goal to base, horizontal, at touchdown
    distance_at_rest_m: np.ndarray  # From goal to base, horizontal, one second after touchdown
    ahead_m: np.ndarray  # Base at rest minus goal, along the heading
    left_m: np.ndarray  # Base at rest minus goal, to the left of the heading
    distance_flown_m: np.ndarray  # Horizontal distance of the base from takeoff to touchdown
    paw_to_paw_distance_m: np.ndarray  # Horizontal, from the paws at takeoff to those at touchdown, mean of four
    tilt_deg: np.ndarray  # Largest tilt since touchdown
    turn_deg: np.ndarray  # Size of the yaw at the end
    stance_m: np.ndarray  # Base height at the command
    squat_m: np.ndarray  # Lowest base height from the command to takeoff
    height_at_end_m: np.ndarray  # Base height at the end
    transversal_deg: np.ndarray  # Largest angle of a transversal motor in flight
    drift_m: np.ndarray  # Horizontal distance of the base from its start at the end

    @property
    def trials(self) -> dict[str, np.ndarray]:
        """Sets of jumps from which metrics are computed: a mask, shaped as the fields, by the name of the set."""
        return {
            "jumps": self.commanded, "jumps that touched down": self.touched_down, "landed jumps": self.landed,
            "successful jumps": self.success, "jumps that did not diverge": self.commanded & ~self.diverged,
        }  # fmt: skip

    @property
    def names(self) -> np.ndarray:
        """Name of the outcome of each landed jump: success, early, missed or not_at_rest; empty for other jumps."""
        kinds = [(self.success, SUCCESS), (self.landed & self.early, "early"), (self.missed, "missed")]
        return np.select(*zip(*kinds, strict=True), default=np.where(self.landed, "not_at_rest", ""))

    def arrays(self) -> dict[str, np.ndarray]:
        """Return all fields by name, such as `landed` and `apex_error_m`, flattened to one value per jump, (jumps,)."""
        return {field.name: getattr(self, field.name).ravel() for field in fields(self)}


def jump_outcome(jumps: JumpLog) -> JumpOutcome:
    """Compute events and errors of the jumps that a log has recorded."""
    ends = jumps.ends
    to_height = jumps.goals[..., 2] > 0.0
    commanded = jumps.ends != NOT_BEGUN
    landed = ends == SUCCESS
    diverged = ends == DIVERGED

    def known(values: np.ndarray) -> np.ndarray:
        """Return the values, with NaN where the simulation diverged."""
        return np.where(diverged | ~np.isfinite(values), np.nan, values)

    def goal_distance(position: np.ndarray) -> np.ndarray:
        """Return the distances [m] of positions (..., 2) from the jumps' goals, NaN where the simulation diverged."""
        return known(np.linalg.norm(position - jumps.goal_world, axis=-1))

    ahead, left = np.moveaxis(turn_plane(jumps.rest_position - jumps.goal_world, -jumps.heading), -1, 0)
    apex_error = known(jumps.apex - jumps.goals[..., 2])
    distance_at_rest = goal_distance(jumps.rest_position)
    off = np.where(to_height, np.abs(apex_error), distance_at_rest)
    reached = np.nan_to_num(off, nan=np.inf) <= TOLERANCE
    at_rest = landed & (jumps.rest_speed < REST_SPEED)
    return JumpOutcome(
        commanded=commanded,
        to_height=to_height,
        early=jumps.early & commanded,
        reached=reached,
        landed=landed,
        touched_down=np.isfinite(jumps.touchdown[..., 0]),
        at_rest=at_rest,
        success=reached & at_rest & ~jumps.early,
        still=landed & (jumps.lift_time <= HOP_TIME - TIME_EPS),
        hopped=jumps.air_time > HOP_TIME + TIME_EPS,
        took_off_again=jumps.takeoffs > 0,
        fell=np.isin(ends, FALLS),
        collided=ends == COLLIDED,
        diverged=diverged,
        missed=landed & ~reached,
        no_jump=ends == "no_jump",
        apex_m=known(jumps.apex),
        apex_error_m=np.where(to_height, apex_error, np.nan),
        distance_at_end_m=goal_distance(jumps.end_position),
        distance_at_touchdown_m=goal_distance(jumps.touchdown),
        distance_at_rest_m=distance_at_rest,
        ahead_m=known(ahead),
        left_m=known(left),
        stance_m=known(jumps.stance),
        squat_m=known(jumps.squat),
        height_at_end_m=known(jumps.end_height),
        transversal_deg=known(np.degrees(jumps.transversal)),
        drift_m=known(jumps.drift),
        distance_flown_m=known(np.linalg.norm(jumps.touchdown - jumps.takeoff, axis=-1)),
        paw_to_paw_distance_m=known(np.linalg.norm(jumps.paw_shift.mean(axis=-2), axis=-1)),
        tilt_deg=known(np.degrees(jumps.tilt)),
        turn_deg=known(np.degrees(np.abs(jumps.yaw))),
    )


class JumpLog(EvaluationLog):
    """Log of one or more jumps in a row per world; arrays have shape (num_envs, jumps in a row), NaN before the jump.

    The goal of the first jump is relative to start and heading. Goals of further jumps are relative to base position
    and yaw at their command. A jump's entries do not change after its end.
    """

    def __init__(
        self,
        goals: np.ndarray,
        terminations: tuple[str, ...],
        headings: np.ndarray | float = 0.0,
        delay: np.ndarray | float = DELAY,
        rest: float = REST_TIME,
    ) -> None:
        """Create a log of jumps that have not begun.

        goals [m]: apex heights of the base, world z, (num_envs,), or landing positions ahead and to the left,
        (num_envs, jumps in a row, 2 or 3), third the apex height, 0 for any; terminations: names of the task's
        terminations, SUCCESS among them; headings [rad]: (num_envs,) or one for all; delay [s]: time until the first
        jump is commanded, likewise; rest [s]: time from touchdown to the end of the jump and the next command. Raises
        InputError: another shape, or no SUCCESS.

        Below, arrays have shape (num_envs, jumps in a row, ...).
        """
        goals = real_array(goals, "goals", float)
        if goals.ndim == 1:
            goals = goals[:, None, None] * [0.0, 0.0, 1.0]
        fits = goals.ndim == 3 and goals.shape[2] in (2, 3)
        check(fits, f"goals must have shape (num_envs,) or (num_envs, jumps, 2 or 3), got {goals.shape}")
        self.goals = np.pad(goals, ((0, 0), (0, 0), (0, 3 - goals.shape[2])))
        self.terminations = terminations
        self.headings = headings
        self.delay = delay
        self.rest = rest
        self.to_heights = bool((self.goals[..., 2] > 0.0).all())  # whether all goals are apex heights
        places = ("goal_x_m", "goal_y_m", "distance_at_rest_m", "apex_m")
        heights = ("goal_height_m", "apex_m", "apex_error_m")
        self.main_columns = (*(heights if self.to_heights else places), "tilt_deg", "outcome")
        self.spacing = 1.2 if self.to_heights else 3.0
        self.count, *_ = shape = goals.shape[:2]
        # (num_envs,) index of the current jump; the number of jumps in a row after the last
        self.current = np.zeros(self.count, dtype=int)
        self.end = np.full(shape, -1)  # index in `terminations` of the jump's end, -1 until then
        self.end_position = np.full((*shape, 2), np.nan)  # [m] (..., 2) base position at the end, world
        self.goal_world = np.full((*shape, 2), np.nan)  # [m] (..., 2) goal, world
        self.takeoff = np.full((*shape, 2), np.nan)  # [m] (..., 2) base position at takeoff, world
        self.touchdown = np.full((*shape, 2), np.nan)  # [m] (..., 2) base position at touchdown, world
        self.rest_position = np.full((*shape, 2), np.nan)  # [m] (..., 2) base position when it should rest, world
        # [m] (..., 4, 2) from each paw's last contact before takeoff to its first contact after touchdown, world axes
        self.paw_shift = np.full((*shape, 4, 2), np.nan)
        self.heading = np.full(shape, np.nan)  # [rad] heading of the jump
        self.yaw = np.full(shape, np.nan)  # [rad] yaw of the base at the end, relative to the heading
        self.drift = np.full(shape, np.nan)  # [m] horizontal distance of the base from its start at the end
        self.stance = np.full(shape, np.nan)  # [m] base height at the command
        self.squat = np.full(shape, np.nan)  # [m] lowest base height from the command to takeoff
        self.end_height = np.full(shape, np.nan)  # [m] base height at the end
        self.transversal = np.full(shape, np.nan)  # [rad] largest angle of a transversal motor in flight
        self.apex = np.full(shape, np.nan)  # [m] largest base height in flight; before takeoff the current one
        self.tilt = np.full(shape, np.nan)  # [rad] largest tilt since touchdown
        self.rest_speed = np.full(shape, np.inf)  # [m/s] speed REST_TIME after touchdown; inf before
        self.early = np.zeros(shape, dtype=bool)  # whether the jump began before the command
        self.air_time = np.zeros(shape)  # [s] longest time with no paw on the ground after touchdown
        self.lift_time = np.zeros(shape)  # [s] longest time off the ground of a paw after its own first contact
        self.takeoffs = np.zeros(shape, dtype=int)  # second takeoffs: upward at TAKEOFF_SPEED with no paw down
        self._air_time = np.zeros(self.count)
        self._paw_air_time = np.zeros((self.count, 4))
        self._paw_start = np.full((self.count, 4, 2), np.nan)  # [m] last contacts before takeoff
        self._paw_touched = np.zeros((self.count, 4), dtype=bool)
        self._rising_flight = np.zeros(self.count, dtype=bool)
        names = ", ".join(terminations)
        check(SUCCESS in terminations, f"the evaluation needs a termination {SUCCESS!r}, the task has {names}")
        self._success = terminations.index(SUCCESS)

    @property
    def seconds(self) -> float:
        """Maximum simulated time [s]: each jump to a place waits, squats and flies for at most 3.5 s."""
        if self.to_heights:
            return 7.0 + self.rest
        return 1.0 + self.goals.shape[1] * (3.5 + self.rest) + float(np.max(self.delay))

    def begin(self, env: Env) -> None:
        """Reset every world to the default pose, and command its first jump `delay` seconds after the reset."""
        env.evaluation_reset(jump_commands(self.goals[:, 0], self.delay, env.step_dt), self.headings)

    def read_env(self, env: Env) -> dict[str, np.ndarray]:
        """Return the task's arrays, those of `paw_arrays`, and `transversal`: largest such motor angle [rad]."""
        angles = motor_values(env.sim.joint_q()[:, 7:]).reshape(-1, 4, 3)
        return env.task_arrays() | paw_arrays(env) | {"transversal": angles[..., 1:].max(axis=(1, 2))}

    def record_step(self, env: Env) -> bool:
        """Record a policy step, and command the next jump where one has ended; return whether all have ended."""
        before = self.current.copy()
        self.arrays = self.read_env(env)
        ended = self.update(self.arrays, env.step_dt)
        due = (self.current > before) & (self.current < self.goals.shape[1])
        if due.any():
            goals = np.zeros((env.num_envs, 3), dtype=np.float32)
            goals[due] = self.goals[due, self.current[due]]
            self.stance[due, self.current[due]] = self.arrays["base_pos"][due, 2]
            env.command(goals, due)
        return ended

    def update(self, arrays: dict[str, np.ndarray], step_dt: float) -> bool:
        """Record a policy step from the arrays of `read_env`; return whether all jumps have ended.

        A jump ends with a termination other than SUCCESS, which ends the row, or `rest` seconds after touchdown.
        """
        count = self.goals.shape[1]
        row = np.flatnonzero(self.current < count)
        jump = {name: values[row] for name, values in arrays.items()}
        at = (row, self.current[row])
        # a policy observes the command after the policy step `command_step`, and can take off in the next one
        self.early[at] |= (jump["took_off"] == 1) & (jump["steps"] <= jump["command_step"])
        self.end_position[at], self.goal_world[at] = jump["base_pos"][:, :2], jump["goal"][:, :2]
        self.heading[at] = jump["heading"]
        self.yaw[at] = wrapped(yaw_of(jump["base_quat"]) - jump["heading"])
        self.drift[at] = np.linalg.norm((jump["base_pos"] - jump["start"])[:, :2], axis=1)
        landed = jump["phase"] == LANDED
        self.tilt[at] = jump["peak_tilt"]
        self.apex[at] = updated_apex(self.apex[at], jump)
        self._record_heights(jump, at)
        self._record_landing(jump, at, landed, step_dt)
        failed = (jump["termination"] >= 0) & (jump["termination"] != self._success)
        rested = ~failed & landed & (jump["phase_steps"] >= round(self.rest / step_dt))
        self.end[at] = np.where(failed, jump["termination"], np.where(rested, self._success, -1))
        self.current[row[rested]] += 1
        self.current[row[failed]] = count
        return bool((self.current >= count).all())

    def _record_heights(self, jump: dict[str, np.ndarray], at: tuple[np.ndarray, np.ndarray]) -> None:
        """Record base heights, and the largest angle of a transversal motor in flight; see `_record_landing`.

        Heights are at the command, the lowest from it to takeoff, and the latest.
        """
        height = jump["base_pos"][:, 2]
        waits = (jump["phase"] == STANCE) & (jump["steps"] <= jump["command_step"])
        prepares = (jump["phase"] == STANCE) & ~waits
        flies = (jump["phase"] != STANCE) & (jump["phase"] != LANDED)
        self.stance[at] = np.where(waits | np.isnan(self.stance[at]), height, self.stance[at])
        self.squat[at] = np.where(prepares, np.fmin(self.squat[at], height), self.squat[at])
        self.end_height[at] = height
        self.transversal[at] = np.where(flies, np.fmax(self.transversal[at], jump["transversal"]), self.transversal[at])

    def _record_landing(
        self, jump: dict[str, np.ndarray], at: tuple[np.ndarray, np.ndarray], landed: np.ndarray, step_dt: float
    ) -> None:
        """Record base positions, speeds and paw contacts after touchdown.

        A paw's shift is from its last contact before takeoff to its first after touchdown. Later lifts of single paws
        (`lift_time`) and of all (`air_time`, `takeoffs`) show whether the landed robot stands still.
        jump: arrays (n, ...) of the n worlds with a current jump; at: indices (worlds, numbers in the row) of
        these jumps; landed: (n,) whether each has touched down; step_dt [s]: policy step.
        """
        row, number = at
        steps = jump["phase_steps"]
        speed = np.linalg.norm(jump["base_vel"], axis=1)
        at_rest = landed & (steps == round(min(self.rest, REST_TIME) / step_dt))
        position = jump["base_pos"][:, :2]
        for record, due, values in (
            (self.takeoff, jump["took_off"] == 1, position),
            (self.touchdown, landed & (jump["touched_down"] == 1), position),
            (self.rest_position, at_rest, position),
            (self.rest_speed, at_rest, speed),
        ):
            record[row[due], number[due]] = values[due]
        down = landed[:, None] & jump["paws_down"]
        pushing = (jump["phase"] == STANCE) | (jump["took_off"] == 1)
        standing = (pushing[:, None] & jump["paws_down"])[..., None]
        self._paw_start[row] = np.where(standing, jump["paw_pos"], self._paw_start[row])
        first = (down & ~self._paw_touched[row])[..., None]
        self.paw_shift[at] = np.where(first, jump["paw_pos"] - self._paw_start[row], self.paw_shift[at])
        airborne = landed & ~down.any(axis=1)
        self._air_time[row] = np.where(airborne, self._air_time[row] + step_dt, 0.0)
        self._paw_touched[row] = landed[:, None] & (self._paw_touched[row] | down)
        self._paw_air_time[row] = np.where(self._paw_touched[row] & ~down, self._paw_air_time[row] + step_dt, 0.0)
        rising_flight = airborne & (self._rising_flight[row] | (jump["up"] > TAKEOFF_SPEED))
        self.takeoffs[at] += rising_flight & ~self._rising_flight[row]
        self._rising_flight[row] = rising_flight
        self.air_time[at] = np.maximum(self.air_time[at], self._air_time[row])
        self.lift_time[at] = np.maximum(self.lift_time[at], self._paw_air_time[row].max(axis=1))

    @property
    def landing(self) -> np.ndarray:
        """Base position when each jump ended [m], ahead and to the left of the jump's start like `goals`, (..., 2)."""
        return self.goals[..., :2] + turn_plane(self.end_position - self.goal_world, -self.heading)

    @property
    def ends(self) -> np.ndarray:
        """How each jump ended, (num_envs, jumps in a row): name of a termination, NO_END or NOT_BEGUN."""
        return np.where(np.isnan(self.heading), NOT_BEGUN, np.array([*self.terminations, NO_END])[self.end])

    @property
    def outcome(self) -> JumpOutcome:
        """Events and errors of all recorded jumps, such as touchdown, success and apex error."""
        return jump_outcome(self)

    @property
    def success(self) -> np.ndarray:
        """Whether each jump succeeded, (num_envs, jumps in a row)."""
        return self.outcome.success

    @property
    def outcomes(self) -> np.ndarray:
        """Outcome of each jump: success, early, missed or not_at_rest if it landed, else how it ended, see `ends`."""
        names = self.outcome.names
        return np.where(names == "", self.ends, names)

    def columns(self) -> dict[str, list]:
        """Return the results of all jumps by name, one value per jump: goal, heading, events, errors and outcome."""
        columns = {name: self.goals[..., i].ravel() for i, name in enumerate(("goal_x_m", "goal_y_m", "goal_height_m"))}
        columns |= {"heading_deg": np.degrees(self.heading).ravel(), **self.outcome.arrays()}
        return listed(columns | {"outcome": self.outcomes.ravel()})

    def all_commands(self) -> np.ndarray:
        """Return the goals of all jumps [m], (num_envs, jumps in a row, 3)."""
        return self.goals

    def series(self) -> dict[str, np.ndarray]:
        """Return present values to plot, (num_envs,) [m]: base height, and commanded height or distance from the goal.

        In their names {} stands for a robot.
        """
        series = {"height/base, {} [m]": self.arrays["base_pos"][:, 2]}
        if self.to_heights:
            return series | {"height/command, {} [m]": self.goals[:, 0, 2]}
        offset = (self.arrays["base_pos"] - self.arrays["goal"])[:, :2]
        return series | {"distance/to goal, {} [m]": np.linalg.norm(offset, axis=1)}

    def states(self) -> dict[str, np.ndarray]:
        """Return the current phase of each world's jump, an entry of PHASES, for recordings."""
        return {"phase/{}": np.array(PHASES)[self.arrays["phase"]]}

    def marks(self) -> dict[str, np.ndarray]:
        """Return the markers of a recording: commanded heights [m], or goals in the world frame with z = 0."""
        if self.to_heights:
            return {"heights": self.goals[:, 0, 2]}
        return {"goals": np.pad(self.goal_world, ((0, 0), (0, 0), (0, 1)))}

    def notes(self, worlds: Sequence[int]) -> Json:
        """Return metadata of a recording: goals [m] of some worlds, heights as `targets_m`, places as `goals_m`."""
        goals = self.goals[list(worlds)]
        return {"targets_m": goals[:, 0, 2].tolist()} if self.to_heights else {"goals_m": goals[..., :2].tolist()}

    def labels(self, worlds: Sequence[int]) -> list[str]:
        """Return titles of some worlds, their first goals in metres: "0.90 m" (up or ahead) or "(0.80, 0.20) m"."""
        goals = self.goals[list(worlds), 0]
        return [f"{x + height:.2f} m" if y == 0.0 else f"({x:.2f}, {y:.2f}) m" for x, y, height in goals]


def wrapped(angle: np.ndarray) -> np.ndarray:
    """Return angles [rad] wrapped into -pi..pi."""
    return np.arctan2(np.sin(angle), np.cos(angle))
