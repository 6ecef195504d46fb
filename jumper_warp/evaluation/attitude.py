"""Commanded turns in free flight: log, metrics, and flags of `jumper evaluate` and `play`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from jumper_warp.envs.env import Env
from jumper_warp.evaluation.film import Film, Filmstrip
from jumper_warp.evaluation.log import (
    COLLIDED,
    DIVERGED,
    NO_END,
    SUCCESS,
    EvaluationLog,
    Metrics,
    failed_by,
    finite,
    mean,
)
from jumper_warp.tasks.cfg import TaskCfg
from jumper_warp.utils.errors import InputError

AXES = ("roll", "pitch", "yaw")
DIRECTIONS = tuple(f"{axis}_{sign}" for axis in AXES for sign in ("plus", "minus"))
"""Turns about the body's x, y and z axes, each way, in the order in which they are commanded."""
HARDWARE_TIME = 2.6  # [s] Time in which the authors' robot turned by 90 degrees
PICTURES = 6  # Number of pictures in a filmstrip


def axis_turns(count: int, angle: float) -> np.ndarray:
    """Return quaternions xyzw, body axes, (count, 4), of turns by an angle [deg] that cycle through DIRECTIONS."""
    half = 0.5 * np.radians(angle)
    quats = np.zeros((count, 4))
    rows = np.arange(count)
    quats[rows, rows % 6 // 2] = np.where(rows % 2 == 0, 1.0, -1.0) * np.sin(half)
    quats[:, 3] = np.cos(half)
    return quats


def random_turns(count: int, angle: float, seed: int) -> np.ndarray:
    """Return quaternions xyzw, body axes, (count, 4), of turns by an angle [deg] about uniformly random axes."""
    axis = np.random.default_rng(seed).normal(size=(count, 3))
    axis /= np.linalg.norm(axis, axis=1, keepdims=True)
    half = 0.5 * np.radians(angle)
    return np.concatenate([np.sin(half) * axis, np.full((count, 1), np.cos(half))], axis=1)


@dataclass
class AttitudeLog(EvaluationLog):
    """Log of one commanded turn per world; arrays have shape (num_envs,). Diverged worlds are not recorded further."""

    turns: np.ndarray
    """(num_envs, 4) Commanded turns, quaternions xyzw, body axes, relative to the orientation at the start."""
    tolerance: float = 5.0  # [deg] Largest error of a robot at its goal
    seconds: float = 5.0  # [s] Simulated time of every turn
    errors: list[np.ndarray] = field(default_factory=list, init=False)
    """[rad] (num_envs,) Angle to the goal after every policy step; NaN once the world has diverged."""
    angular_speeds: list[np.ndarray] = field(default_factory=list, init=False)
    """[rad/s] (num_envs,) Angular speed of the base after every policy step."""
    collided: np.ndarray = field(init=False)
    """Whether a link other than a paw touched the ground, or links touched each other."""
    diverged: np.ndarray = field(init=False)  # Whether the simulation diverged

    row_name = "turn"
    spacing = 1.5

    def __post_init__(self) -> None:
        """Begin with nothing recorded."""
        self.turns, self.count = np.asarray(self.turns, dtype=float), len(self.turns)
        self.collided, self.diverged = (np.zeros(self.count, dtype=bool) for _ in range(2))
        self.step_dt = 1.0 / 60.0

    def begin(self, env: Env) -> None:
        """Reset every robot to the default pose, floating at rest, and command its turn."""
        self.step_dt = env.step_dt
        env.evaluation_reset(self.turns)

    def read_env(self, env: Any) -> dict[str, np.ndarray]:
        """Return the state of every world's episode and the base's angular velocity [rad/s], world frame."""
        return env.task_arrays() | {"base_ang_vel": env.sim.joint_qd()[:, 3:6].copy()}

    def update(self, arrays: dict[str, np.ndarray], step_dt: float) -> bool:
        """Record a policy step from the arrays of `read_env`; return whether all worlds have diverged."""
        self.diverged |= arrays["termination"] >= 0
        self.errors.append(np.where(self.diverged, np.nan, arrays["error"]))
        self.angular_speeds.append(np.where(self.diverged, np.nan, np.linalg.norm(arrays["base_ang_vel"], axis=1)))
        self.collided |= (arrays["collisions"] > 0) & ~self.diverged
        return bool(self.diverged.all())

    @property
    def angle(self) -> np.ndarray:
        """[rad] (num_envs,) Commanded angle."""
        return 2.0 * np.arctan2(np.linalg.norm(self.turns[:, :3], axis=1), np.abs(self.turns[:, 3]))

    @property
    def error(self) -> np.ndarray:
        """[rad] (num_envs,) Angle to the goal at the end."""
        return self.errors[-1]

    @property
    def first_time(self) -> np.ndarray:
        """[s] (num_envs,) Time at which a robot first reached its goal; NaN if it never did."""
        inside = np.array(self.errors) <= np.radians(self.tolerance)
        return np.where(inside.any(axis=0), (inside.argmax(axis=0) + 1) * self.step_dt, np.nan)

    @property
    def settling_time(self) -> np.ndarray:
        """[s] (num_envs,) Time from which a robot stayed at its goal; NaN if it was not there at the end."""
        inside = np.array(self.errors) <= np.radians(self.tolerance)
        outside = np.where((~inside).any(axis=0), len(inside) - (~inside)[::-1].argmax(axis=0), 0)
        return np.where(inside[-1], (outside + 1) * self.step_dt, np.nan)

    @property
    def success(self) -> np.ndarray:
        """Whether a robot was at its goal at the end, without any collision."""
        return ~np.isnan(self.settling_time) & ~self.collided

    @property
    def outcomes(self) -> np.ndarray:
        """Outcome of each turn: SUCCESS, COLLIDED, DIVERGED, or NO_END if not at the goal."""
        ends = np.where(self.success, SUCCESS, np.where(self.collided, COLLIDED, NO_END))
        return np.where(self.diverged, DIVERGED, ends)

    def columns(self) -> dict[str, list]:
        """Return turns, errors [deg], times [s] and outcomes, one value per turn."""
        numbers = {f"turn_{axis}": self.turns[:, i] for i, axis in enumerate("xyzw")}
        numbers |= {"error_deg": np.degrees(self.error), "first_s": self.first_time, "settling_s": self.settling_time}
        return {name: finite(values) for name, values in numbers.items()} | {"end": self.outcomes.tolist()}

    def series(self, worlds: Sequence[int]) -> dict[str, float]:
        """Return angle to the goal [deg] and angular speed [rad/s] of some worlds."""
        series = {}
        for world in worlds:
            series[f"attitude/error of {world} [deg]"] = float(np.degrees(np.nan_to_num(self.errors[-1][world])))
            series[f"spin/of {world} [rad/s]"] = float(np.nan_to_num(self.angular_speeds[-1][world]))
        return series

    def notes(self, worlds: Sequence[int]) -> dict[str, Any]:
        """Return the commanded turns of some worlds."""
        return {"turns_xyzw": self.turns[list(worlds)].tolist()}

    def filmstrip(self, film: Film) -> Filmstrip:
        """Return a filmstrip of the first recorded world until it has settled."""
        world = film.worlds[0]
        until = np.nan_to_num(self.settling_time[world], nan=self.seconds)
        frames = np.linspace(0, round(until / self.step_dt) - 1, PICTURES).round().astype(int).tolist()
        captions = [f"{(i + 1) * self.step_dt:.2f} s, {np.degrees(self.errors[i][world]):.0f} deg" for i in frames]
        height = float(film.base_positions(0)[0, 2])
        view = {"eye": (1.2, 1.5, height + 0.5), "target": (0.0, 0.0, height - 0.05), "size": (320, 320)}
        return Filmstrip(0, frames, captions, **view, name="turn_strip")


def turn_metrics(turns: AttitudeLog) -> Metrics:
    """Return the metrics of turns; times are means over the turns that settled, rates are over all."""
    settling, outcomes = turns.settling_time, turns.outcomes
    metrics: Metrics = {
        "turns": len(outcomes),
        "mean_angle_deg": mean(np.degrees(turns.angle)),
        "tolerance_deg": turns.tolerance,
        "success_rate": float(turns.success.mean()),
        "within_2_6_s_rate": float((turns.success & (np.nan_to_num(settling, nan=np.inf) <= HARDWARE_TIME)).mean()),
        "mean_error_at_end_deg": mean(np.degrees(turns.error)),
        "mean_first_s": mean(turns.first_time),
        "mean_settling_s": mean(settling),
        "max_settling_s": mean(settling[settling == np.nanmax(settling)]) if np.isfinite(settling).any() else None,
        "mean_spin_at_end_rad_s": mean(turns.angular_speeds[-1]),
        "collision_rate": float(turns.collided.mean()),
        DIVERGED: int(turns.diverged.sum()),
    }
    return metrics | failed_by(outcomes[~turns.success])


def axis_metrics(turns: AttitudeLog) -> Metrics:
    """Return mean settling time, success rate and final error of turns of `axis_turns`, by direction."""
    metrics: Metrics = {}
    for i, name in enumerate(DIRECTIONS):
        metrics[f"{name}_settling_s"] = mean(turns.settling_time[i::6])
        metrics[f"{name}_success_rate"] = mean(turns.success[i::6].astype(float))
        metrics[f"{name}_error_at_end_deg"] = mean(np.degrees(turns.error[i::6]))
    return metrics


@dataclass(frozen=True)
class AttitudeFlags:
    """Turns about the body's axes, each way, from rest in the default pose."""

    num_turns: int = 60
    """Number of turns."""
    angle: float = 90.0
    """[deg] Angle of every turn."""
    tolerance: float = 5.0
    """[deg] Error up to which a robot is at its goal."""
    seconds: float = 5.0
    """[s] Length of every turn's episode."""

    def __post_init__(self) -> None:
        if self.num_turns < len(DIRECTIONS):
            raise InputError(f"num_turns must be at least {len(DIRECTIONS)}, got {self.num_turns}")
        if not 0.0 < self.angle <= 180.0 or not 0.0 < self.tolerance <= 180.0:
            raise InputError(f"angle and tolerance must be in (0, 180] degrees, got {self.angle}, {self.tolerance}")
        if not 0.1 <= self.seconds <= 60.0:
            raise InputError(f"seconds must be in [0.1, 60], got {self.seconds}")

    def log(self, task: TaskCfg, seed: int) -> AttitudeLog:
        """Return the log of the turns, one per world."""
        return AttitudeLog(axis_turns(self.num_turns, self.angle), self.tolerance, self.seconds)

    def metrics(self, log: AttitudeLog) -> Metrics:
        """Return `turn_metrics` and `axis_metrics`."""
        return turn_metrics(log) | axis_metrics(log)


@dataclass(frozen=True)
class AttitudePlayFlags:
    """Turns that are recorded, about the body's axes, each way."""

    angle: float = 90.0
    """[deg] Angle of every turn."""

    length = 4.0

    def __post_init__(self) -> None:
        if not 0.0 < self.angle <= 180.0:
            raise InputError(f"angle must be in (0, 180] degrees, got {self.angle}")

    def log(self, task: TaskCfg) -> AttitudeLog:
        """Return the log of six turns, one per robot."""
        return AttitudeLog(axis_turns(len(DIRECTIONS), self.angle), seconds=self.length)
