"""Base class of the logs of jumps: one sequence of jumps per world, each from its command to rest after landing."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from jumper_warp.envs.env import Env
from jumper_warp.evaluation.log import (
    COLLIDED,
    DIVERGED,
    NO_END,
    EvaluationLog,
    Metrics,
    largest,
    mean,
    mean_and_max,
    success_index,
)
from jumper_warp.utils.errors import InputError

PHASES = ("stance", "flight", "landed")  # Names of the values of a jump's phase
STANCE, LANDED = 0, 2  # Values of the jump's phase before takeoff and after touchdown
REST_SPEED = 0.1  # [m/s] Speed of the base's centre of mass below which the robot is at rest
REST_TIME = 1.0  # [s] Time after touchdown at which the robot should be at rest
DELAY = 0.5  # [s] Time until the first jump is commanded
SOON_AFTER = 0.3  # [s] Time after touchdown at which the base position is recorded as well
HOP_TIME = 0.05  # [s] After touchdown, longer without any paw on the ground is a hop; a paw lifted so long is a step
TAKEOFF_SPEED = 0.25  # [m/s] Upward speed of the base, with no paw down, of a second takeoff (authors' configuration)
TIME_EPS = 1.0e-6  # [s] Tolerance for rounding of sums of steps
NOT_BEGUN = "not_begun"  # Outcome of a jump that was not commanded, as one before it failed


def paw_arrays(env: Env) -> dict[str, np.ndarray]:
    """Return `paws_down` (num_envs, 4), whether FL, FR, BL, BR touch ground, and `up` (num_envs,), base speed [m/s]."""
    force = np.linalg.norm(env.sim.paw_force.numpy(), axis=2)
    return {"paws_down": (force > env.task.contact_force).T, "up": env.sim.base_velocity()[:, 2]}


def jump_commands(goals: np.ndarray, delay: np.ndarray | float, step_dt: float) -> np.ndarray:
    """Return commands of jump tasks, (num_envs, 4): goal x, y, z [m] and number of the policy step of the command.

    goals [m]: (num_envs, 3), landing x, y relative to start and heading, and base height at the apex, 0 for any;
    delay [s]: time until the jump is commanded, (num_envs,) or one for all.
    """
    steps = np.broadcast_to(np.round(np.asarray(delay) / step_dt), len(goals))
    return np.concatenate([goals, steps[:, None]], axis=1).astype(np.float32)


class JumpLog(EvaluationLog):
    """Log of a sequence of jumps per world; arrays have shape (num_envs, jumps in a row), NaN before the jump.

    The goal of the first jump is relative to start and heading, that of each further jump to base position and yaw at
    its command. A jump's entries do not change after its end.
    """

    speed_time: float  # [s] Time after touchdown at which the base's speed is recorded

    def __init__(
        self,
        goals: np.ndarray,
        terminations: tuple[str, ...],
        headings: np.ndarray | float = 0.0,
        delay: np.ndarray | float = DELAY,
        rest: float = REST_TIME,
    ) -> None:
        """Start with no jump ended.

        goals [m]: landing positions ahead and to the left, (num_envs, jumps in a row, 2 or 3), third the base height at
        the apex, 0 for any; terminations: names of the task's terminations, SUCCESS among them; headings [rad]:
        (num_envs,) or one for all; delay [s]: time until the first jump is commanded, likewise; rest [s]: time from
        touchdown until the jump is over and the next one is commanded. Raises InputError: another shape, or no SUCCESS.

        Below, arrays have shape (num_envs, jumps in a row, ...).
        """
        goals = np.asarray(goals, dtype=float)
        if goals.ndim != 3 or goals.shape[2] not in (2, 3):
            raise InputError(f"goals must have shape (num_envs, jumps, 2 or 3), got {goals.shape}")
        self.goals, self.terminations = np.pad(goals, ((0, 0), (0, 0), (0, 3 - goals.shape[2]))), terminations
        self.headings, self.delay, self.rest, self.speed_time = headings, delay, rest, rest
        self.count, *_ = shape = goals.shape[:2]
        # (num_envs,) index of the jump under way; the number of jumps in a row after the last
        self.current = np.zeros(self.count, dtype=int)
        self.end = np.full(shape, -1)  # index in `terminations` of what ended the jump, -1 while under way
        self.end_position = np.full((*shape, 2), np.nan)  # [m] (..., 2) base position at the end, world
        self.goal_world = np.full((*shape, 2), np.nan)  # [m] (..., 2) goal, world
        self.touchdown = np.full((*shape, 2), np.nan)  # [m] (..., 2) base position at touchdown, world
        self.position_soon = np.full((*shape, 2), np.nan)  # [m] (..., 2) base position SOON_AFTER touchdown, world
        self.heading = np.full(shape, np.nan)  # [rad] heading of the jump
        self.yaw = np.full(shape, np.nan)  # [rad] yaw of the base at the end, relative to the heading
        self.drift = np.full(shape, np.nan)  # [m] horizontal distance of the base from its start at the end
        self.apex = np.full(shape, np.nan)  # [m] largest base height
        self.tilt = np.full(shape, np.nan)  # [rad] largest tilt since touchdown
        self.rest_speed = np.full(shape, np.inf)  # [m/s] speed `speed_time` after touchdown; inf before
        self.early = np.zeros(shape, dtype=bool)  # whether the jump began before the command
        self.air_time = np.zeros(shape)  # [s] longest time with no paw on the ground after touchdown
        self.lift_time = np.zeros(shape)  # [s] longest time off the ground of a paw after its own first contact
        self.takeoffs = np.zeros(shape, dtype=int)  # second takeoffs: upward at TAKEOFF_SPEED with no paw down
        self._air_time, self._paw_air_time = np.zeros(self.count), np.zeros((self.count, 4))
        self._paw_touched, self._rising_flight = np.zeros((self.count, 4), dtype=bool), np.zeros(self.count, dtype=bool)
        self._success = success_index(terminations)

    def begin(self, env: Env) -> None:
        """Reset every world to the default pose, and command its first jump `delay` seconds after the reset."""
        env.evaluation_reset(jump_commands(self.goals[:, 0], self.delay, env.step_dt), self.headings)

    def read_env(self, env: Env) -> dict[str, np.ndarray]:
        """Return `Env.task_arrays` and `paw_arrays`."""
        return env.task_arrays() | paw_arrays(env)

    def record_step(self, env: Env) -> bool:
        """Record a policy step, command the next jumps that are due; return whether all jumps have ended."""
        before = self.current.copy()
        ended = super().record_step(env)
        due = (self.current > before) & (self.current < self.goals.shape[1])
        if due.any():
            goals = np.zeros((env.num_envs, 3), dtype=np.float32)
            goals[due] = self.goals[due, self.current[due]]
            env.command(goals, due)
        return ended

    def update(self, arrays: dict[str, np.ndarray], step_dt: float) -> bool:
        """Record a policy step from the arrays of `read_env`; return whether all jumps have ended.

        A jump ends with a termination other than SUCCESS, which ends the row, or `rest` seconds after touchdown.
        """
        count = self.goals.shape[1]
        row = np.flatnonzero(self.current < count)
        now = {name: values[row] for name, values in arrays.items()}
        at = (row, self.current[row])
        self._record_early(arrays, at)
        self.end_position[at], self.goal_world[at] = now["base_pos"][:, :2], now["goal"][:, :2]
        self.heading[at] = now["heading"]
        self.yaw[at] = wrapped(yaw_of(now["base_quat"]) - now["heading"])
        self.drift[at] = np.linalg.norm((now["base_pos"] - now["start"])[:, :2], axis=1)
        self.apex[at], self.tilt[at] = now["max_height"], now["peak_tilt"]
        landed = now["phase"] == LANDED
        self._record_landing(now, at, landed, step_dt)
        failed = (now["termination"] >= 0) & (now["termination"] != self._success)
        rested = ~failed & landed & (now["phase_steps"] >= round(self.rest / step_dt))
        self.end[at] = np.where(failed, now["termination"], np.where(rested, self._success, -1))
        self.current[row[rested]] += 1
        self.current[row[failed]] = count
        return bool((self.current >= count).all())

    def _record_early(self, arrays: dict[str, np.ndarray], at: tuple[np.ndarray, np.ndarray]) -> None:
        """Mark jumps that take off before the command.

        arrays: of all worlds; at: indices (worlds, numbers in the row), (n,) each, of the n jumps under way.
        """
        takes_off = (arrays["took_off"] == 1) & (arrays["steps"] < arrays["command_step"])
        self.early[at] |= takes_off[at[0]]

    def _record_landing(
        self, now: dict[str, np.ndarray], at: tuple[np.ndarray, np.ndarray], landed: np.ndarray, step_dt: float
    ) -> None:
        """Record base positions, speeds and paw contacts after touchdown.

        now: arrays (n, ...) of the n worlds whose jumps are under way; at: indices (worlds, numbers in the row) of
        these jumps; landed: (n,) whether each has touched down; step_dt [s]: policy step.
        """
        row, number = at
        steps, speed = now["phase_steps"], np.linalg.norm(now["base_vel"], axis=1)
        for record, is_time, values in (
            (self.touchdown, now["touched_down"] == 1, now["base_pos"][:, :2]),
            (self.position_soon, steps == round(SOON_AFTER / step_dt), now["base_pos"][:, :2]),
            (self.rest_speed, steps == round(self.speed_time / step_dt), speed),
        ):
            due = landed & is_time
            record[row[due], number[due]] = values[due]
        down = landed[:, None] & now["paws_down"]
        airborne = landed & ~down.any(axis=1)
        self._air_time[row] = np.where(airborne, self._air_time[row] + step_dt, 0.0)
        self._paw_touched[row] = landed[:, None] & (self._paw_touched[row] | down)
        self._paw_air_time[row] = np.where(self._paw_touched[row] & ~down, self._paw_air_time[row] + step_dt, 0.0)
        rising_flight = airborne & (self._rising_flight[row] | (now["up"] > TAKEOFF_SPEED))
        self.takeoffs[at] += rising_flight & ~self._rising_flight[row]
        self._rising_flight[row] = rising_flight
        self.air_time[at] = np.maximum(self.air_time[at], self._air_time[row])
        self.lift_time[at] = np.maximum(self.lift_time[at], self._paw_air_time[row].max(axis=1))

    @property
    def ends(self) -> np.ndarray:
        """(num_envs, jumps in a row) Name of the termination of each jump, NO_END or NOT_BEGUN."""
        names = np.array([*self.terminations, NO_END], dtype=object)[self.end]
        return np.where(self.begun, names, NOT_BEGUN)

    @property
    def begun(self) -> np.ndarray:
        """Whether the jump was commanded."""
        return ~np.isnan(self.heading)

    @property
    def diverged(self) -> np.ndarray:
        """Whether the simulation diverged."""
        return self.ends == DIVERGED

    @property
    def landed(self) -> np.ndarray:
        """Whether the robot landed on its paws and stayed up until the jump was over, wherever it landed."""
        return self.end == self._success

    @property
    def hopped(self) -> np.ndarray:
        """Whether all paws together were off the ground for longer than HOP_TIME after touchdown."""
        return self.air_time > HOP_TIME + TIME_EPS

    @property
    def stepped(self) -> np.ndarray:
        """Whether a paw was off the ground for HOP_TIME or longer after its first contact."""
        return self.lift_time > HOP_TIME - TIME_EPS

    @property
    def still(self) -> np.ndarray:
        """Whether the robot landed without a step, wherever it landed."""
        return self.landed & ~self.stepped

    def series(self, worlds: Sequence[int]) -> dict[str, float]:
        """Return the present base height [m] of some worlds."""
        heights = self.arrays["base_pos"][list(worlds), 2]
        return {f"height/base, {name} [m]": height for name, height in zip(self.names(worlds), heights, strict=True)}

    def states(self, worlds: Sequence[int]) -> dict[str, str]:
        """Return the phase of some worlds' jumps."""
        phases = self.arrays["phase"][list(worlds)]
        return {f"phase/{name}": PHASES[phase] for name, phase in zip(self.names(worlds), phases, strict=True)}


def stance_metrics(jumps: JumpLog) -> Metrics:
    """Return the rates of still landings and collisions among commanded jumps, tilt and turn [deg] of landed ones."""
    begun, landed = jumps.begun, jumps.landed
    return {
        "still_landing_rate": mean(jumps.still[begun]),
        "collision_rate": mean((jumps.ends == COLLIDED)[begun]),
        "max_landing_tilt_deg": largest(np.degrees(jumps.tilt[landed])),
        **mean_and_max("turn_deg", np.degrees(np.abs(jumps.yaw))[landed]),
    }


@dataclass(frozen=True)
class JumpFlags:
    """Jumps from standing still."""

    num_jumps: int = 200  # Number of jumps
    success_range: tuple[float, float] = field(default=(0.3, 1.4), kw_only=True)
    """[m] Smallest and largest distance or height counted by `success_rate_in_range`."""

    def __post_init__(self) -> None:
        if self.num_jumps < 1:
            raise InputError(f"num_jumps must be at least 1, got {self.num_jumps}")
        if not 0.0 <= self.success_range[0] <= self.success_range[1] < 10.0:
            raise InputError(f"success_range must be in [0, 10) m and rise, got {self.success_range}")


def yaw_of(quat: np.ndarray) -> np.ndarray:
    """Return the yaw [rad], (...), of quaternions (..., 4), xyzw: angle of body x in the world plane, from world x."""
    x, y, z, w = np.moveaxis(quat, -1, 0)
    return np.arctan2(2.0 * (x * y + w * z), 1.0 - 2.0 * (y * y + z * z))


def wrapped(angle: np.ndarray) -> np.ndarray:
    """Return angles [rad] wrapped into -pi..pi."""
    return np.arctan2(np.sin(angle), np.cos(angle))
