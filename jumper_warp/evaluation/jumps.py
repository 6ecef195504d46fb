"""Log of jumps: one row of jumps in every world, each from its command to the rest after its landing."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from jumper_warp.envs.env import Env
from jumper_warp.evaluation.log import (
    CAME_APART,
    COLLIDED,
    NO_END,
    EvaluationLog,
    Metrics,
    largest,
    mean,
    mean_and_max,
    success_index,
)
from jumper_warp.utils.errors import InputError

STANCE, LANDED = 0, 2
"""Values of the jump's phase before takeoff and after touchdown."""
REST_SPEED = 0.1
"""[m/s] Of the base's centre of mass, below which it is at rest."""
REST_TIME = 1.0
"""[s] After touchdown, when it should be."""
DELAY = 0.5
"""[s] Until the first jump is commanded."""
SOON = 0.3
"""[s] After touchdown, when the base's place is recorded as well."""
HOP_TIME = 0.05
"""[s] A robot that is off the ground for longer after touchdown has jumped again; one that lifts a paw, which had come
down, for as long has stepped."""
TAKEOFF_SPEED = 0.25
"""[m/s] Upward speed of the base, with no paw down, of a second takeoff (authors' configuration)."""
TIME_EPS = 1.0e-6
"""[s] Rounding of sums of steps."""
NOT_BEGUN = "not_begun"
"""Outcome of a jump that was due after one that failed."""


def paw_arrays(env: Env) -> dict[str, np.ndarray]:
    """Return which paws are on the ground, (num_envs, 4), and the base's upward speed [m/s]."""
    force = np.linalg.norm(env.sim.paw_force.numpy(), axis=2)
    return {"paws_down": (force > env.task.contact_force).T, "up": env.sim.base_velocity()[:, 2]}


def jump_commands(goals: np.ndarray, delay: np.ndarray | float, step_dt: float) -> np.ndarray:
    """Return commands (num_envs, 4) of jump tasks.

    goals [m]: (num_envs, 3), landing x, y relative to start and heading, and base height at the apex, 0 if any will do.
    delay [s]: until the jump is commanded; (num_envs,) or one for all.
    """
    steps = np.broadcast_to(np.round(np.asarray(delay) / step_dt), len(goals))
    return np.concatenate([goals, steps[:, None]], axis=1).astype(np.float32)


class JumpLog(EvaluationLog):
    """One row of jumps per world; arrays have shape (num_envs, jumps in a row), NaN before the jump.

    The first jump goes to a place relative to start and heading, each other one relative to the base's place and yaw
    when it is commanded. Nothing of a jump changes after its end.
    """

    speed_time: float
    """[s] After touchdown, when the base's speed is recorded."""

    def __init__(
        self,
        goals: np.ndarray,
        terminations: tuple[str, ...],
        headings: np.ndarray | float = 0.0,
        delay: np.ndarray | float = DELAY,
        rest: float = REST_TIME,
    ) -> None:
        """Begin with no jump ended.

        goals: [m] (num_envs, jumps in a row, 2) landing places ahead and to the left, or 3: with the base height at the
        apex, 0 if any will do; terminations: names of the ends of an episode, SUCCESS among them; headings: [rad]
        (num_envs,) or one for all; delay: [s] until the first jump is commanded, likewise; rest: [s] from touchdown
        until the jump is over, and the next one commanded. Raises InputError: another shape, or no SUCCESS.
        """
        goals = np.asarray(goals, dtype=float)
        if goals.ndim != 3 or goals.shape[2] not in (2, 3):
            raise InputError(f"goals must have shape (num_envs, jumps, 2 or 3), got {goals.shape}")
        self.goals, self.terminations = np.pad(goals, ((0, 0), (0, 0), (0, 3 - goals.shape[2]))), terminations
        self.headings, self.delay, self.rest, self.speed_time = headings, delay, rest, rest
        self.count, *_ = shape = goals.shape[:2]
        self.current = np.zeros(
            self.count, dtype=int
        )  # (num_envs,) number of the jump under way; after the end, of all
        self.end = np.full(shape, -1)  # index of the end in `terminations`, -1 before it
        self.place = np.full((*shape, 2), np.nan)  # [m] (..., 2) base at the end, world
        self.target = np.full((*shape, 2), np.nan)  # [m] (..., 2) where it should be, world
        self.touchdown = np.full((*shape, 2), np.nan)  # [m] (..., 2) base at touchdown, world
        self.place_soon = np.full((*shape, 2), np.nan)  # [m] (..., 2) base SOON after touchdown, world
        self.heading = np.full(shape, np.nan)  # [rad] of the jump
        self.yaw = np.full(shape, np.nan)  # [rad] of the base at the end, from the jump's heading
        self.drift = np.full(shape, np.nan)  # [m] of the base in the plane, from the start to the end
        self.apex = np.full(shape, np.nan)  # [m] largest base height
        self.tilt = np.full(shape, np.nan)  # [rad] largest since touchdown
        self.rest_speed = np.full(shape, np.inf)  # [m/s] of the base `speed_time` after touchdown; infinite before
        self.early = np.zeros(shape, dtype=bool)  # whether the jump began before the command
        self.air_time = np.zeros(shape)  # [s] longest that no paw was on the ground after touchdown
        self.lift_time = np.zeros(shape)  # [s] longest that a paw was off the ground after its own first contact
        self.takeoffs = np.zeros(shape, dtype=int)  # after touchdown: upward at TAKEOFF_SPEED with no paw down
        self._aloft, self._lifted = np.zeros(self.count), np.zeros((self.count, 4))
        self._came_down, self._flies = np.zeros((self.count, 4), dtype=bool), np.zeros(self.count, dtype=bool)
        self._success = success_index(terminations)

    def begin(self, env: Env) -> None:
        """Stand every world in the default pose with its first goal."""
        env.evaluation_reset(jump_commands(self.goals[:, 0], self.delay, env.step_dt), self.headings)

    def look(self, env: Env) -> dict[str, np.ndarray]:
        """Return the state of every world's episode, which of its paws are on the ground, and how fast it rises."""
        return env.task_arrays() | paw_arrays(env)

    def follow(self, env: Env) -> bool:
        """Look at the environment after a policy step, and command the jumps that are due."""
        before = self.current.copy()
        ended = super().follow(env)
        due = (self.current > before) & (self.current < self.goals.shape[1])
        if due.any():
            goals = np.zeros((env.num_envs, 3), dtype=np.float32)
            goals[due] = self.goals[due, self.current[due]]
            env.command(goals, due)
        return ended

    def update(self, arrays: dict[str, np.ndarray], step_dt: float) -> bool:
        """Take in a policy step; return whether all jumps have ended."""
        count = self.goals.shape[1]
        row = np.flatnonzero(self.current < count)
        now = {name: values[row] for name, values in arrays.items()}
        at = (row, self.current[row])
        self._mark_early(arrays, at)
        self.place[at], self.target[at] = now["base_pos"][:, :2], now["goal"][:, :2]
        self.heading[at] = now["heading"]
        self.yaw[at] = wrapped(yaw_of(now["base_quat"]) - now["heading"])
        self.drift[at] = np.linalg.norm((now["base_pos"] - now["start"])[:, :2], axis=1)
        self.apex[at], self.tilt[at] = now["max_height"], now["peak_tilt"]
        landed = now["phase"] == LANDED
        self._follow_landing(now, at, landed, step_dt)
        failed = (now["ending"] >= 0) & (now["ending"] != self._success)
        rested = ~failed & landed & (now["phase_steps"] >= round(self.rest / step_dt))
        self.end[at] = np.where(failed, now["ending"], np.where(rested, self._success, -1))
        self.current[row[rested]] += 1
        self.current[row[failed]] = count
        return bool((self.current >= count).all())

    def _mark_early(self, arrays: dict[str, np.ndarray], at: tuple[np.ndarray, np.ndarray]) -> None:
        """Mark the jumps that take off before the command; at: worlds and numbers of the jumps under way."""
        takes_off = (arrays["took_off"] == 1) & (arrays["steps"] < arrays["command_step"])
        self.early[at] |= takes_off[at[0]]

    def _follow_landing(
        self, now: dict[str, np.ndarray], at: tuple[np.ndarray, np.ndarray], landed: np.ndarray, step_dt: float
    ) -> None:
        """Take in where the bases of the jumps under way are after touchdown, and what their paws do."""
        row, number = at
        steps, speed = now["phase_steps"], np.linalg.norm(now["base_vel"], axis=1)
        for kept, moment, values in (
            (self.touchdown, now["touched_down"] == 1, now["base_pos"][:, :2]),
            (self.place_soon, steps == round(SOON / step_dt), now["base_pos"][:, :2]),
            (self.rest_speed, steps == round(self.speed_time / step_dt), speed),
        ):
            due = landed & moment
            kept[row[due], number[due]] = values[due]
        down = landed[:, None] & now["paws_down"]
        aloft = landed & ~down.any(axis=1)
        self._aloft[row] = np.where(aloft, self._aloft[row] + step_dt, 0.0)
        self._came_down[row] = landed[:, None] & (self._came_down[row] | down)
        self._lifted[row] = np.where(self._came_down[row] & ~down, self._lifted[row] + step_dt, 0.0)
        flies = aloft & (self._flies[row] | (now["up"] > TAKEOFF_SPEED))
        self.takeoffs[at] += flies & ~self._flies[row]
        self._flies[row] = flies
        self.air_time[at] = np.maximum(self.air_time[at], self._aloft[row])
        self.lift_time[at] = np.maximum(self.lift_time[at], self._lifted[row].max(axis=1))

    @property
    def ends(self) -> np.ndarray:
        """Name of each jump's end, whether or not it met its goal."""
        names = np.array([*self.terminations, NO_END], dtype=object)[self.end]
        return np.where(self.begun, names, NOT_BEGUN)

    @property
    def begun(self) -> np.ndarray:
        """Whether the jump was begun."""
        return ~np.isnan(self.heading)

    @property
    def broken(self) -> np.ndarray:
        """Whether the simulation came apart."""
        return self.ends == CAME_APART

    @property
    def landed(self) -> np.ndarray:
        """Whether the robot came down on its paws and stayed there, wherever it was."""
        return self.end == self._success

    @property
    def hopped(self) -> np.ndarray:
        """Whether the robot jumped again after touchdown."""
        return self.air_time > HOP_TIME + TIME_EPS

    @property
    def stepped(self) -> np.ndarray:
        """Whether any paw that had come down was off the ground again for HOP_TIME or longer."""
        return self.lift_time > HOP_TIME - TIME_EPS

    @property
    def still(self) -> np.ndarray:
        """Whether the robot landed, wherever it was, without a step."""
        return self.landed & ~self.stepped

    def series(self, worlds: Sequence[int]) -> dict[str, float]:
        """Return the base's height [m]."""
        return {f"height/base of {world} [m]": self.seen["base_pos"][world, 2] for world in worlds}


def stance_metrics(jumps: JumpLog) -> Metrics:
    """Return still landings and collisions, shares of all jumps, and the largest tilt and turns of the landed ones."""
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

    num_jumps: int = 200
    """Number of jumps."""
    success_range: tuple[float, float] = field(default=(0.3, 1.4), kw_only=True)
    """[m] Smallest and largest distance or height counted by `success_rate_in_range`."""

    def __post_init__(self) -> None:
        """Raises InputError: a setting is out of range."""
        if self.num_jumps < 1:
            raise InputError(f"num_jumps must be at least 1, got {self.num_jumps}")
        if not 0.0 <= self.success_range[0] <= self.success_range[1] < 10.0:
            raise InputError(f"success_range must be in [0, 10) m and rise, got {self.success_range}")


def yaw_of(quat: np.ndarray) -> np.ndarray:
    """Return the yaw [rad] of orientations (..., 4), xyzw: the heading of body x in the world plane."""
    x, y, z, w = np.moveaxis(quat, -1, 0)
    return np.arctan2(2.0 * (x * y + w * z), 1.0 - 2.0 * (y * y + z * z))


def wrapped(angle: np.ndarray) -> np.ndarray:
    """Return angles [rad] within -pi..pi."""
    return np.arctan2(np.sin(angle), np.cos(angle))
