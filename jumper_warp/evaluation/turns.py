"""Turns in free flight: what is asked for, and the metrics of what became of it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from jumper_warp.envs.env import Env
from jumper_warp.evaluation.film import Film, Strip
from jumper_warp.evaluation.log import (
    CAME_APART,
    COLLIDED,
    NO_END,
    SUCCESS,
    EvaluationLog,
    Metrics,
    failures,
    finite,
    mean,
)
from jumper_warp.tasks.cfg import TaskCfg
from jumper_warp.utils.errors import InputError

AXES = ("roll", "pitch", "yaw")
DIRECTIONS = tuple(f"{axis}_{sign}" for axis in AXES for sign in ("plus", "minus"))
"""Turns about x, y and z of the body, each way, in the order in which they are asked for."""
HARDWARE_TIME = 2.6
"""[s] In which the authors' robot turned by 90 degrees."""
SHOWN = 6
"""Pictures of a filmstrip."""


def turns_about_axes(count: int, angle: float) -> np.ndarray:
    """Return turns (count, 4), quaternions xyzw in body axes, by an angle [deg], about DIRECTIONS in turn."""
    half = 0.5 * np.radians(angle)
    quats = np.zeros((count, 4))
    rows = np.arange(count)
    quats[rows, rows % 6 // 2] = np.where(rows % 2 == 0, 1.0, -1.0) * np.sin(half)
    quats[:, 3] = np.cos(half)
    return quats


def turns_about_any(count: int, angle: float, seed: int) -> np.ndarray:
    """Return turns (count, 4), quaternions xyzw in body axes, by an angle [deg], about axes drawn over the sphere."""
    axis = np.random.default_rng(seed).normal(size=(count, 3))
    axis /= np.linalg.norm(axis, axis=1, keepdims=True)
    half = 0.5 * np.radians(angle)
    return np.concatenate([np.sin(half) * axis, np.full((count, 1), np.cos(half))], axis=1)


@dataclass
class Turns(EvaluationLog):
    """What became of one turn per world; arrays have shape (num_envs,). What came apart is followed no further."""

    turns: np.ndarray
    """(num_envs, 4) Commanded, quaternions xyzw, body axes, from the orientation at the start."""
    tolerance: float = 5.0
    """[deg] Error up to which a robot is at its goal."""
    seconds: float = 5.0
    """Of which every turn is followed."""
    errors: list[np.ndarray] = field(default_factory=list, init=False)
    """[rad] (num_envs,) after every policy step; not a number from where the world came apart."""
    spins: list[np.ndarray] = field(default_factory=list, init=False)
    """[rad/s] (num_envs,) Angular speeds of the base."""
    collided: np.ndarray = field(init=False)
    """Whether anything but a paw touched the ground, or links touched each other."""
    apart: np.ndarray = field(init=False)
    """Whether the simulation came apart."""

    row = "turn"
    spacing = 1.5

    def __post_init__(self) -> None:
        """Begin with nothing done."""
        self.turns, self.count = np.asarray(self.turns, dtype=float), len(self.turns)
        self.collided, self.apart = (np.zeros(self.count, dtype=bool) for _ in range(2))
        self.step_dt = 1.0 / 60.0

    def begin(self, env: Env) -> None:
        """Let every robot float in the default pose with its turn to make."""
        self.step_dt = env.step_dt
        env.evaluation_reset(self.turns)

    def look(self, env: Any) -> dict[str, np.ndarray]:
        """Return the state of every world's episode, and its base's angular velocity."""
        return env.task_arrays() | {"base_ang_vel": env.sim.joint_qd()[:, 3:6].copy()}

    def update(self, arrays: dict[str, np.ndarray], step_dt: float) -> bool:
        """Take in a policy step; return whether all have come apart."""
        self.apart |= arrays["ending"] >= 0
        self.errors.append(np.where(self.apart, np.nan, arrays["error"]))
        self.spins.append(np.where(self.apart, np.nan, np.linalg.norm(arrays["base_ang_vel"], axis=1)))
        self.collided |= (arrays["collisions"] > 0) & ~self.apart
        return bool(self.apart.all())

    @property
    def angle(self) -> np.ndarray:
        """[rad] (num_envs,) Commanded."""
        return 2.0 * np.arctan2(np.linalg.norm(self.turns[:, :3], axis=1), np.abs(self.turns[:, 3]))

    @property
    def error(self) -> np.ndarray:
        """[rad] At the end."""
        return self.errors[-1]

    @property
    def first(self) -> np.ndarray:
        """[s] Until a robot was at its goal first; not a number if it never was."""
        inside = np.array(self.errors) <= np.radians(self.tolerance)
        return np.where(inside.any(axis=0), (inside.argmax(axis=0) + 1) * self.step_dt, np.nan)

    @property
    def settling(self) -> np.ndarray:
        """[s] Until a robot was at its goal to stay; not a number if it was not there at the end."""
        inside = np.array(self.errors) <= np.radians(self.tolerance)
        outside = np.where((~inside).any(axis=0), len(inside) - (~inside)[::-1].argmax(axis=0), 0)
        return np.where(inside[-1], (outside + 1) * self.step_dt, np.nan)

    @property
    def success(self) -> np.ndarray:
        """Whether a robot was at its goal at the end, and nothing had touched anything."""
        return ~np.isnan(self.settling) & ~self.collided

    @property
    def outcomes(self) -> np.ndarray:
        """Name of what became of each turn."""
        ends = np.where(self.success, SUCCESS, np.where(self.collided, COLLIDED, NO_END))
        return np.where(self.apart, CAME_APART, ends)

    def columns(self) -> dict[str, list]:
        """Return the turns, errors [deg] and times [s]."""
        numbers = {f"turn_{axis}": self.turns[:, i] for i, axis in enumerate("xyzw")}
        numbers |= {"error_deg": np.degrees(self.error), "first_s": self.first, "settling_s": self.settling}
        return {name: finite(values) for name, values in numbers.items()} | {"end": self.outcomes.tolist()}

    def series(self, worlds: Sequence[int]) -> dict[str, float]:
        """Return errors and angular speeds."""
        series = {}
        for world in worlds:
            series[f"attitude/error of {world} [deg]"] = float(np.degrees(np.nan_to_num(self.errors[-1][world])))
            series[f"spin/of {world} [rad/s]"] = float(np.nan_to_num(self.spins[-1][world]))
        return series

    def notes(self, worlds: Sequence[int]) -> dict[str, Any]:
        """Return the turns."""
        return {"turns_xyzw": self.turns[list(worlds)].tolist()}

    def strip(self, film: Film) -> Strip:
        """Return pictures of the first filmed turn, until it has settled."""
        world = film.worlds[0]
        until = np.nan_to_num(self.settling[world], nan=self.seconds)
        frames = np.linspace(0, round(until / self.step_dt) - 1, SHOWN).round().astype(int).tolist()
        captions = [f"{(i + 1) * self.step_dt:.2f} s, {np.degrees(self.errors[i][world]):.0f} deg" for i in frames]
        height = float(film.base(0)[0, 2])
        view = {"eye": (1.2, 1.5, height + 0.5), "target": (0.0, 0.0, height - 0.05), "size": (320, 320)}
        return Strip(0, frames, captions, **view, name="turn_strip")


def turn_metrics(turns: Turns) -> Metrics:
    """Return the metrics of turns; times are means over those that settled, rates are of all."""
    settling, outcomes = turns.settling, turns.outcomes
    metrics: Metrics = {
        "turns": len(outcomes),
        "mean_angle_deg": mean(np.degrees(turns.angle)),
        "tolerance_deg": turns.tolerance,
        "success_rate": float(turns.success.mean()),
        "within_2_6_s_rate": float((turns.success & (np.nan_to_num(settling, nan=np.inf) <= HARDWARE_TIME)).mean()),
        "mean_error_at_end_deg": mean(np.degrees(turns.error)),
        "mean_first_s": mean(turns.first),
        "mean_settling_s": mean(settling),
        "max_settling_s": mean(settling[settling == np.nanmax(settling)]) if np.isfinite(settling).any() else None,
        "mean_spin_at_end_rad_s": mean(turns.spins[-1]),
        "collision_rate": float(turns.collided.mean()),
        CAME_APART: int(turns.apart.sum()),
    }
    return metrics | failures(outcomes[~turns.success])


def axis_metrics(turns: Turns) -> Metrics:
    """Return mean settling times and success rates of turns of `turns_about_axes`, by axis and direction."""
    metrics: Metrics = {}
    for i, name in enumerate(DIRECTIONS):
        metrics[f"{name}_settling_s"] = mean(turns.settling[i::6])
        metrics[f"{name}_success_rate"] = mean(turns.success[i::6].astype(float))
        metrics[f"{name}_error_at_end_deg"] = mean(np.degrees(turns.error[i::6]))
    return metrics


@dataclass(frozen=True)
class TurnFlags:
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
        """Raises InputError: a setting is out of range."""
        if self.num_turns < len(DIRECTIONS):
            raise InputError(f"num_turns must be at least {len(DIRECTIONS)}, got {self.num_turns}")
        if not 0.0 < self.angle <= 180.0 or not 0.0 < self.tolerance <= 180.0:
            raise InputError(f"angle and tolerance must be in (0, 180] degrees, got {self.angle}, {self.tolerance}")
        if not 0.1 <= self.seconds <= 60.0:
            raise InputError(f"seconds must be in [0.1, 60], got {self.seconds}")

    def log(self, task: TaskCfg, seed: int) -> Turns:
        """Return the turns."""
        return Turns(turns_about_axes(self.num_turns, self.angle), self.tolerance, self.seconds)

    def metrics(self, log: Turns) -> Metrics:
        """Return `turn_metrics` and `axis_metrics`."""
        return turn_metrics(log) | axis_metrics(log)


@dataclass(frozen=True)
class TurnGoals:
    """Turns that are recorded, about the body's axes, each way."""

    angle: float = 90.0
    """[deg] Angle of every turn."""

    length = 4.0

    def __post_init__(self) -> None:
        """Raises InputError: the angle is out of range."""
        if not 0.0 < self.angle <= 180.0:
            raise InputError(f"angle must be in (0, 180] degrees, got {self.angle}")

    def log(self, task: TaskCfg) -> Turns:
        """Return one turn a robot."""
        return Turns(turns_about_axes(len(DIRECTIONS), self.angle), seconds=self.length)
