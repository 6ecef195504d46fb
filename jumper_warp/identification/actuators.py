"""One motor on a test bench: torque against speed, and steps of torque; limits, friction and latency from them.

A bench drives the output shaft at a speed and measures the torque that comes out while the motor is commanded. With
speed w [rad/s] and a commanded torque c [N m], after the latency,

    torque = fade(w) clamp(c, -limit(-w), limit(w)) - friction sign(w),

limit and fade as in `jumper_warp.kernels.actuation.motors`; the response to a step of the command follows first order
with a time constant of the current loop.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from scipy.optimize import least_squares

from jumper_warp.identification.motions import csv_rows
from jumper_warp.identification.uncertainty import mismatch_factor
from jumper_warp.robot.description import load_description
from jumper_warp.robot.motors import OVERSPEED_END, OVERSPEED_START
from jumper_warp.utils.checks import check_positive
from jumper_warp.utils.errors import InputError

COLUMNS = ("test", "time", "command", "speed", "torque")
"""Columns of a bench's data: number of the test; [s]; [N m] commanded; [rad/s] of the output; [N m] measured there."""
STANDSTILL = 0.01
"""[rad/s] Below it friction falls linearly to zero, as in the simulation."""
PRIORS = {
    "saturation": (0.5, "N m"), "peak": (0.3, "N m"), "cutoff_speed": (0.3, "rad/s"), "no_load_speed": (0.3, "rad/s"),
    "fade_start": (0.2, "rad/s"), "fade_end": (0.2, "rad/s"), "friction": (1.5, "N m"), "latency": (2.0, "s"),
    "time_constant": (2.0, "s"),
}  # fmt: skip
"""Deviation of the logarithm, and unit, of each constant."""
FASTEST = 1.0e-4
"""[s] Latency and time constant that are told from 0."""


@dataclass(frozen=True, eq=False)
class Bench:
    """Rows of a test bench; every test begins with the command and speed of its first row, long before."""

    test: np.ndarray
    """(n,) int"""
    time: np.ndarray
    """(n,) [s], rising within a test."""
    command: np.ndarray
    """(n,) [N m], held until the next row."""
    speed: np.ndarray
    """(n,) [rad/s]"""
    torque: np.ndarray
    """(n,) [N m]"""

    def __post_init__(self) -> None:
        """Raises InputError: columns of different lengths, not finite, or times that do not rise."""
        n = len(self.time)
        for name in COLUMNS:
            values = getattr(self, name)
            if values.shape != (n,) or n < 10:
                raise InputError(f"bench: {name} must be one column of at least 10 rows, got shape {values.shape}")
            if not np.isfinite(values).all():
                raise InputError(f"bench: {name} is not finite in row {int(np.argmin(np.isfinite(values)))}")
        same = np.diff(self.test) == 0
        if (np.diff(self.time)[same] <= 0.0).any():
            raise InputError("bench: time must rise within each test")
        if np.abs(self.speed).max() > 300.0:
            raise InputError(f"bench: speed reaches {np.abs(self.speed).max():.4g} rad/s: is it in rpm or deg/s?")


def load_bench(path: Path) -> Bench:
    """Return the data of a CSV file with the names COLUMNS in its first line.

    Raises InputError: what is wrong with it; OSError: it cannot be read.
    """
    rows = csv_rows(Path(path))
    names = [name.strip() for name in rows[0]] if rows else []
    missing = [name for name in COLUMNS if name not in names]
    if missing:
        raise InputError(f"{path}: column {missing[0]} is missing; expected {', '.join(COLUMNS)}")
    try:
        table = np.array([[float(row[names.index(name)]) for name in COLUMNS] for row in rows[1:]])
    except (ValueError, IndexError):
        raise InputError(f"{path}: every row must hold {len(names)} numbers") from None
    try:
        return Bench(*table.reshape(-1, len(COLUMNS)).T)
    except InputError as error:
        raise InputError(f"{path}: {error}") from None


def torque_law(constants: Mapping[str, float], command: np.ndarray, speed: np.ndarray) -> np.ndarray:
    """Return the torque at the output [N m] of a motor that has settled."""
    ahead = np.sign(command) * speed
    headroom = (constants["no_load_speed"] - ahead) / (constants["no_load_speed"] - constants["cutoff_speed"])
    limit = np.minimum(constants["saturation"], constants["peak"] * np.clip(headroom, 0.0, 1.0))
    bounded = np.sign(command) * np.minimum(np.abs(command), limit)
    fade = (constants["fade_end"] - np.abs(speed)) / (constants["fade_end"] - constants["fade_start"])
    friction = constants["friction"] * np.clip(speed / STANDSTILL, -1.0, 1.0)
    return bounded * np.clip(fade, 0.0, 1.0) - friction


def response(constants: Mapping[str, float], bench: Bench) -> np.ndarray:
    """Return the torques [N m] that a bench would measure."""
    found = np.zeros(len(bench.time))
    for test in np.unique(bench.test):
        rows = np.flatnonzero(bench.test == test)
        time, command = bench.time[rows], bench.command[rows]
        # the command, late and smoothed: a sum of the responses to its steps
        late = np.full(len(rows), command[0])
        for i in np.flatnonzero(np.diff(command)) + 1:
            after = (time - time[i] - constants["latency"]) / constants["time_constant"]
            late += (command[i] - command[i - 1]) * np.where(after > 0.0, 1.0 - np.exp(-np.maximum(after, 0.0)), 0.0)
        found[rows] = torque_law(constants, late, bench.speed[rows])
    return found


@dataclass(frozen=True, eq=False)
class Actuator:
    """What was found of a motor."""

    kind: str
    constants: Mapping[str, float]
    intervals: Mapping[str, tuple[float, float]]
    """95 %, wider where the law does not explain the data."""
    open: tuple[str, ...]
    """Constants of which the data says less than what was known before."""
    chi2: float
    """Mean squared weighed residual."""

    def rows(self) -> dict[str, tuple[float, float, float, str]]:
        """Return (value, low, high, unit) of each constant by name."""
        return {name: (value, *self.intervals[name], PRIORS[name][1]) for name, value in self.constants.items()}

    def to_json(self) -> dict[str, Any]:
        """Return everything as JSON can hold it."""
        rows = {
            name: {"value": value, "interval_95": [low, high], "unit": unit, "identified": name not in self.open}
            for name, (value, low, high, unit) in self.rows().items()
        }
        return {"motor": self.kind, "chi2": self.chi2, "constants": rows}


def described_constants(kind: Literal["lateral", "transversal"]) -> dict[str, float]:
    """Return the constants of a kind of motor as described."""
    motor = load_description().motors[0 if kind == "lateral" else 1]
    return {
        "saturation": 18.0, "peak": motor.peak_torque, "cutoff_speed": motor.cutoff_speed,
        "no_load_speed": motor.no_load_speed, "fade_start": OVERSPEED_START, "fade_end": OVERSPEED_END,
        "friction": motor.coulomb_friction, "latency": 1.0e-3, "time_constant": 1.0e-3,
    }  # fmt: skip


def characterise_motor(
    bench: Bench, kind: Literal["lateral", "transversal"] = "transversal", torque_noise: float = 0.1
) -> Actuator:
    """Return the constants of a motor that explain a bench's data best; torque_noise [N m]: of its sensor.

    Raises InputError: noise that is not positive, or data without torque.
    """
    check_positive("torque noise", torque_noise)
    if np.ptp(bench.command) == 0.0:
        raise InputError("bench: the command never changes, which tells nothing of the motor")
    nominal = described_constants(kind)
    names = list(PRIORS)
    prior = np.array([PRIORS[name][0] for name in names])

    def constants(z: np.ndarray) -> dict[str, float]:
        values = {name: nominal[name] * math.exp(p * x) for name, p, x in zip(names, prior, z, strict=True)}
        values["no_load_speed"] = max(values["no_load_speed"], 1.001 * values["cutoff_speed"])
        values["fade_end"] = max(values["fade_end"], 1.001 * values["fade_start"])
        return values

    def residuals(z: np.ndarray) -> np.ndarray:
        return np.concatenate([(response(constants(z), bench) - bench.torque) / torque_noise, z])

    starts = [np.zeros(len(names))]
    for late in (-1.5, 1.0):  # a delay and a slow rise look alike from far away
        starts.append(np.where(np.array(names) == "latency", late, 0.0))
    fits = [least_squares(residuals, start, diff_step=1.0e-5, x_scale="jac", max_nfev=100) for start in starts]
    best = min(fits, key=lambda fit: fit.cost)
    errors = best.fun[: len(bench.time)]
    chi2 = float(np.mean(errors**2))
    factor = mismatch_factor([errors[bench.test == test][:, None] for test in np.unique(bench.test)])
    deviation = np.minimum(factor * np.sqrt(np.diag(np.linalg.inv(best.jac.T @ best.jac))), 1.0)
    found = constants(best.x)
    intervals = {
        name: (value * math.exp(-1.96 * p * d), value * math.exp(1.96 * p * d))
        for (name, value), p, d in zip(found.items(), prior, deviation, strict=True)
    }
    unknown = tuple(name for name, d in zip(names, deviation, strict=True) if d > 0.5)
    return Actuator(kind, found, intervals, unknown, chi2)
