"""Evaluation of commanded turns in free flight: log, metrics, and flags of `jumper evaluate` and `play`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

from jumper_warp.evaluation.log import COLLIDED, DIVERGED, NO_END, SUCCESS, EvaluationLog, check, listed
from jumper_warp.tasks.cfg import TaskCfg
from jumper_warp.utils.arrays import real_array
from jumper_warp.utils.errors import InputError
from jumper_warp.utils.files import Json
from jumper_warp.utils.metrics import Metric, Metrics, chosen, largest, mean, measure, rate

if TYPE_CHECKING:
    from jumper_warp.envs.env import Env

AXES = ("roll", "pitch", "yaw")
DIRECTIONS = tuple(f"{axis}_{sign}" for axis in AXES for sign in ("plus", "minus"))
"""Names of turns about the body's x, y and z axes: roll_plus, roll_minus, pitch_plus, ...; plus is right-handed."""
HARDWARE_TIME = 2.6  # [s] Settling time of the authors' robot for a turn by 90 degrees


def axis_turns(count: int, angle: float) -> np.ndarray:
    """Return rotations by an angle [deg] about the axes of DIRECTIONS in cyclic order, quaternions (count, 4), xyzw."""
    half = 0.5 * np.radians(angle)
    rows = np.arange(count)
    quats = np.zeros((count, 4))
    quats[rows, rows % 6 // 2] = np.where(rows % 2 == 0, 1.0, -1.0) * np.sin(half)  # even rows: plus, odd: minus
    quats[:, 3] = np.cos(half)
    return quats


@dataclass
class AttitudeLog(EvaluationLog):
    """Log of one commanded turn in free flight per world; properties: (num_envs,). A diverged world records NaN."""

    turns: np.ndarray  # (num_envs, 4) Commanded turns, quaternions xyzw, body axes, relative to the start
    tolerance: float = 5.0  # [deg] Largest error of a robot at its goal
    seconds: float = 5.0  # [s] Simulated time of every turn
    errors: list[np.ndarray] = field(default_factory=list, init=False)
    """Angle to the goal [rad], one array (num_envs,) per policy step; NaN once the world has diverged."""
    angular_speeds: list[np.ndarray] = field(default_factory=list, init=False)
    """Angular speed of the base [rad/s], one array (num_envs,) per policy step; NaN once the world has diverged."""
    collided: np.ndarray = field(init=False)  # (num_envs,) Whether a link other than a paw, or two links, touched
    diverged: np.ndarray = field(init=False)  # (num_envs,) Whether the simulation diverged

    row_name = "turn"
    spacing = 1.5

    def __post_init__(self) -> None:
        """Check `turns`, and allocate an outcome per world. Raises InputError: they are no real numbers."""
        self.turns, self.count = real_array(self.turns, "turns", float), len(self.turns)
        self.collided, self.diverged = (np.zeros(self.count, dtype=bool) for _ in range(2))
        self.step_dt = 1.0 / 60.0  # [s] Policy step; `begin` sets that of the environment

    def begin(self, env: Env) -> None:
        """Reset every robot to the default pose, floating at rest, and command its turn."""
        self.step_dt = env.step_dt
        env.evaluation_reset(self.turns)

    def read_env(self, env: Env) -> dict[str, np.ndarray]:
        """Return the task's arrays and the base's angular velocity [rad/s] by name, for `update`.

        `Env.task_arrays`, and `base_ang_vel` (num_envs, 3), world axes.
        """
        return env.task_arrays() | {"base_ang_vel": env.sim.joint_qd()[:, 3:6].copy()}

    def update(self, arrays: dict[str, np.ndarray], step_dt: float) -> bool:
        """Record a policy step from the arrays of `read_env`; return whether all worlds have diverged."""
        self.diverged |= arrays["termination"] >= 0
        self.errors.append(np.where(self.diverged, np.nan, arrays["error"]))
        self.angular_speeds.append(np.where(self.diverged, np.nan, np.linalg.norm(arrays["base_ang_vel"], axis=1)))
        self.collided |= (arrays["collisions"] > 0) & ~self.diverged
        return bool(self.diverged.all())

    @property
    def error(self) -> np.ndarray:
        """Angle to the goal after the last policy step [rad], (num_envs,); NaN if the world has diverged."""
        return self.errors[-1]

    @property
    def first_time(self) -> np.ndarray:
        """Time at which the error first was within `tolerance` [s], (num_envs,); NaN if it never was."""
        inside = np.array(self.errors) <= np.radians(self.tolerance)
        return np.where(inside.any(axis=0), (inside.argmax(axis=0) + 1) * self.step_dt, np.nan)

    @property
    def settling_time(self) -> np.ndarray:
        """Time from which the error stays within `tolerance` to the end [s], (num_envs,); NaN if there is none.

        That is the end of the policy step after the last one whose error is larger.
        """
        inside = np.array(self.errors) <= np.radians(self.tolerance)
        outside = np.where((~inside).any(axis=0), len(inside) - (~inside)[::-1].argmax(axis=0), 0)
        return np.where(inside[-1], (outside + 1) * self.step_dt, np.nan)

    @property
    def success(self) -> np.ndarray:
        """Whether each turn succeeded, (num_envs,): error within `tolerance` at the end, and no collision."""
        return ~np.isnan(self.settling_time) & ~self.collided

    @property
    def trials(self) -> dict[str, np.ndarray]:
        """Sets of turns from which metrics are computed: a mask (num_envs,) by the set's name, such as "turns"."""
        return {"turns": np.full(self.count, True), "turns that settled": ~np.isnan(self.settling_time),
                "turns that reached the goal": ~np.isnan(self.first_time),
                "turns that did not diverge": ~self.diverged}  # fmt: skip

    @property
    def outcomes(self) -> np.ndarray:
        """Outcome of each turn, (num_envs,): SUCCESS, COLLIDED, DIVERGED, or NO_END if not at the goal at the end."""
        ends = np.where(self.success, SUCCESS, np.where(self.collided, COLLIDED, NO_END))
        return np.where(self.diverged, DIVERGED, ends)

    def columns(self) -> dict[str, list]:
        """Return one value per turn by name: commanded quaternion, final error, times to the goal, outcome.

        Keys: turn_x to turn_w, error_deg, first_s (`first_time`), settling_s (`settling_time`), end (outcome).
        """
        columns = {f"turn_{axis}": self.turns[:, i] for i, axis in enumerate("xyzw")}
        columns |= {"error_deg": np.degrees(self.error), "first_s": self.first_time, "settling_s": self.settling_time}
        return listed(columns | {"end": self.outcomes})

    def series(self) -> dict[str, np.ndarray]:
        """Return the current angle to the goal [deg] and angular speed [rad/s] of all worlds; NaN is replaced by 0."""
        error = np.nan_to_num(self.errors[-1])
        speed = np.nan_to_num(self.angular_speeds[-1])
        return {"error/angle to goal, {} [deg]": np.degrees(error), "spin/angular speed, {} [rad/s]": speed}

    def notes(self, worlds: Sequence[int]) -> Json:
        """Return metadata of a recording: the commanded turns of some worlds, key `turns_xyzw`, quaternions."""
        return {"turns_xyzw": self.turns[list(worlds)].tolist()}


TURN_METRICS = (
    Metric("settled_without_collision_rate", rate, "turns", lambda o: o.success),
    Metric("settled_within_2_6_s_rate", rate, "turns", lambda o: o.success & ~(o.settling_time > HARDWARE_TIME)),
    Metric("settling_time_mean_s", mean, "turns that settled", lambda o: o.settling_time),
    Metric("settling_time_max_s", largest, "turns that settled", lambda o: o.settling_time),
    Metric("first_time_mean_s", mean, "turns that reached the goal", lambda o: o.first_time),
    Metric("error_at_end_mean_deg", mean, "turns that did not diverge", lambda o: np.degrees(o.error)),
    Metric("spin_at_end_mean_rad_s", mean, "turns that did not diverge", lambda o: o.angular_speeds[-1]),
    Metric("collision_rate", rate, "turns", lambda o: o.collided),
    Metric("diverged_rate", rate, "turns", lambda o: o.diverged),
)
"""Table of the metrics of turns; a turn has settled if its error stays within the tolerance until the end."""


def axis_metrics(turns: AttitudeLog) -> Metrics:
    """Return success rate, settling time and final error of turns about each body axis and direction.

    Keys: `<direction>_<key>` for DIRECTIONS; turns: log of `axis_turns`.
    """
    rows = chosen(TURN_METRICS, "settling_time_mean_s", "settled_without_collision_rate", "error_at_end_mean_deg")
    number = np.arange(turns.count) % len(DIRECTIONS)
    metrics = {}
    for i, name in enumerate(DIRECTIONS):
        metrics |= measure(rows, turns, number == i, f"{name}_", name.replace("_", " "))
    return metrics


@dataclass(frozen=True)
class AttitudeFlags:
    """Flags of `jumper evaluate` for turns in free flight about the body's axes, from rest in the default pose."""

    num_turns: int = 60  # Number of turns
    angle: float = 90.0  # [deg] Angle of every turn
    tolerance: float = 5.0  # [deg] Largest error of a robot that has reached its goal
    seconds: float = 5.0  # [s] Length of every turn's episode

    def __post_init__(self) -> None:
        """Raise InputError for a number of turns, angle or duration out of range."""
        if self.num_turns < len(DIRECTIONS):
            raise InputError(f"num_turns must be at least {len(DIRECTIONS)}, got {self.num_turns}")
        if not 0.0 < self.angle <= 180.0 or not 0.0 < self.tolerance <= 180.0:
            raise InputError(f"angle and tolerance must be in (0, 180] degrees, got {self.angle}, {self.tolerance}")
        check(0.1 <= self.seconds <= 60.0, f"seconds must be in [0.1, 60], got {self.seconds}")

    def log(self, task: TaskCfg, seed: int) -> AttitudeLog:
        """Return a new log of one turn per world about the body's axes; task and seed have no effect."""
        return AttitudeLog(axis_turns(self.num_turns, self.angle), self.tolerance, self.seconds)

    def metrics(self, log: AttitudeLog) -> Metrics:
        """Return the metrics of a finished log of turns, together and for each axis and direction."""
        return measure(TURN_METRICS, log) | axis_metrics(log)


@dataclass(frozen=True)
class AttitudePlayFlags:
    """Flags of `jumper play` for turns about the body's axes, in both directions."""

    angle: float = 90.0  # [deg] Angle of every turn

    length = 4.0  # [s] Length of the recording

    def __post_init__(self) -> None:
        """Raise InputError for an angle [deg] out of range."""
        check(0.0 < self.angle <= 180.0, f"angle must be in (0, 180] degrees, got {self.angle}")

    def log(self, task: TaskCfg) -> AttitudeLog:
        """Return a new log of six turns, one per robot, in the order of DIRECTIONS; task has no effect."""
        return AttitudeLog(axis_turns(len(DIRECTIONS), self.angle), seconds=self.length)
