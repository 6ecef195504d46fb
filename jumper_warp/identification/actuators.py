"""Identification of one motor's limits, friction and latency from torque sweeps and torque steps on a test bench.

The bench drives the output shaft at a speed and measures the output torque while the motor is commanded. With
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

from jumper_warp.identification.motions import cell_number, csv_rows
from jumper_warp.identification.uncertainty import mismatch_factor
from jumper_warp.robot.description import load_description
from jumper_warp.robot.motors import OVERSPEED_END, OVERSPEED_START
from jumper_warp.utils.arrays import real_array
from jumper_warp.utils.checks import check_within
from jumper_warp.utils.errors import InputError

COLUMNS = ("test", "time", "command", "speed", "torque")
"""Columns of a bench's CSV: test number, time [s], commanded torque [N m], output speed [rad/s] and torque [N m]."""
STANDSTILL = 0.01  # [rad/s] Output speed below which friction falls linearly to zero, as in the simulation
PRIORS = {
    "saturation": (0.5, "N m"), "peak": (0.3, "N m"), "cutoff_speed": (0.3, "rad/s"), "no_load_speed": (0.3, "rad/s"),
    "fade_start": (0.2, "rad/s"), "fade_end": (0.2, "rad/s"), "friction": (1.5, "N m"), "latency": (2.0, "s"),
    "time_constant": (2.0, "s"),
}  # fmt: skip
"""Constants of a motor by name: standard deviation of ln(value / described value) in the prior, and unit of the value.

saturation: limit on the commanded torque; peak: torque limit below cutoff_speed, from where it falls linearly to 0 at
no_load_speed; fade_start, fade_end: speeds between which all torque fades to 0; time_constant: of the current loop."""


LARGEST_CHI2 = 10.0  # Largest mean squared error over the noise of a fit that is consistent
MOST_DEVIATIONS = 5.0  # Largest plausible distance of a constant from the described one, in deviations of the prior


@dataclass(frozen=True, eq=False)
class Bench:
    """Test-bench recording of a motor's commanded torque, speed and measured torque, n rows.

    Command and speed of a test's first row also hold before that row.
    """

    test: np.ndarray  # (n,) number of the test that a row belongs to
    time: np.ndarray  # (n,) [s], rising within a test
    command: np.ndarray  # (n,) [N m] commanded torque, held until the next row
    speed: np.ndarray  # (n,) [rad/s] of the output shaft
    torque: np.ndarray  # (n,) [N m] measured at the output shaft

    def __post_init__(self) -> None:
        """Raise InputError for unequal columns, below 10 rows, NaN, falling times, or speeds above 300 rad/s."""
        n = np.size(self.time)
        for name in COLUMNS:
            values = real_array(getattr(self, name), f"bench: {name}", np.float64)
            object.__setattr__(self, name, values)
            if values.shape != (n,) or n < 10:
                raise InputError(f"bench: {name} must be one column of at least 10 rows, got shape {values.shape}")
            if not np.isfinite(values).all():
                raise InputError(f"bench: {name} is not finite in row {int(np.argmin(np.isfinite(values)))}")
        if (np.diff(self.time)[np.diff(self.test) == 0] <= 0.0).any():
            raise InputError("bench: time must rise within each test")
        if np.abs(self.speed).max() > 300.0:
            raise InputError(f"bench: speed reaches {np.abs(self.speed).max():.4g} rad/s: is it in rpm or deg/s?")


def load_bench(path: Path) -> Bench:
    """Read a test-bench recording from a CSV file. The first line names at least the columns `COLUMNS`, in any order.

    Raises InputError: a missing file or column, rows that are not numbers, or as `Bench`; OSError: it cannot be read.
    """
    rows = csv_rows(path, "recording of a test bench")
    names = [name.strip() for name in rows[0]] if rows else []
    missing = [name for name in COLUMNS if name not in names]
    if missing:
        raise InputError(f"{path}: column {missing[0]} is missing; expected {', '.join(COLUMNS)}")
    try:
        table = np.array([[cell_number(row[names.index(name)]) for name in COLUMNS] for row in rows[1:]])
    except (ValueError, IndexError):
        raise InputError(f"{path}: every row must hold {len(names)} numbers") from None
    try:
        return Bench(*table.reshape(-1, len(COLUMNS)).T)
    except InputError as error:
        raise InputError(f"{path}: {error}") from None


def torque_law(constants: Mapping[str, float], command: np.ndarray, speed: np.ndarray) -> np.ndarray:
    """Return a motor's steady output torque [N m] from its commanded torque [N m] and output speed [rad/s].

    All of one shape. constants: by the names and units of `PRIORS`. A positive torque accelerates a positive speed.
    """
    driving_speed = np.sign(command) * speed
    headroom = (constants["no_load_speed"] - driving_speed) / (constants["no_load_speed"] - constants["cutoff_speed"])
    limit = np.minimum(constants["saturation"], constants["peak"] * np.clip(headroom, 0.0, 1.0))
    bounded = np.sign(command) * np.minimum(np.abs(command), limit)
    fade = (constants["fade_end"] - np.abs(speed)) / (constants["fade_end"] - constants["fade_start"])
    friction = constants["friction"] * np.clip(speed / STANDSTILL, -1.0, 1.0)
    return bounded * np.clip(fade, 0.0, 1.0) - friction


def bench_torque(constants: Mapping[str, float], bench: Bench) -> np.ndarray:
    """Simulate the noiseless torques [N m] that a test bench measures on a motor, (n,); constants: as in `PRIORS`."""
    torque = np.zeros(len(bench.time))
    for test in np.unique(bench.test):
        rows = np.flatnonzero(bench.test == test)
        time, command = bench.time[rows], bench.command[rows]
        # the delayed and smoothed command is the sum of the responses to its steps
        followed = np.full(len(rows), command[0])
        for i in np.flatnonzero(np.diff(command)) + 1:
            after = (time - time[i] - constants["latency"]) / constants["time_constant"]
            followed += (command[i] - command[i - 1]) * np.where(
                after > 0.0, 1.0 - np.exp(-np.maximum(after, 0.0)), 0.0
            )
        torque[rows] = torque_law(constants, followed, bench.speed[rows])
    return torque


@dataclass(frozen=True, eq=False)
class Actuator:
    """Identified limits, friction and latency of a motor, with their uncertainty."""

    kind: str  # "lateral" or "transversal"
    constants: Mapping[str, float]  # By the names and units of `PRIORS`
    intervals: Mapping[str, tuple[float, float]]  # 95 % intervals, wider where the law does not fit the data
    open: tuple[str, ...]  # Names of the constants whose standard deviation is above half the prior's: not identified
    chi2: float  # [1] Mean over rows of (torque error / torque noise)^2; 1 if the law fits to the noise
    deviations: Mapping[str, float]  # Distance from the described constants, in standard deviations of the prior

    @property
    def inconsistency(self) -> str:
        """Reasons why the fit cannot be trusted, one line; empty if there are none.

        A wrong sign or unit of the torque, or a dead sensor, gives constants far from those of any motor of this kind.
        """
        reasons = [f"χ² {self.chi2:.4g} above {LARGEST_CHI2:g}"] if not self.chi2 <= LARGEST_CHI2 else []
        for name, distance in self.deviations.items():
            if abs(distance) > MOST_DEVIATIONS:
                value = f"{name} {self.constants[name]:.3g} {PRIORS[name][1]}"
                reasons.append(f"{value} is {abs(distance):.3g} standard deviations from the described one")
        return ", ".join(reasons)

    def rows(self) -> dict[str, tuple[float, float, float, str]]:
        """Return a motor's identified constants by name, each as (value, low, high, unit) with its 95 % interval."""
        return {name: (value, *self.intervals[name], PRIORS[name][1]) for name, value in self.constants.items()}

    def to_json(self) -> dict[str, Any]:
        """Return the identified constants of a motor as the content of `actuator.json`."""
        rows = {
            name: {"value": value, "interval_95": [low, high], "unit": unit, "identified": name not in self.open}
            for name, (value, low, high, unit) in self.rows().items()
        }
        return {"motor": self.kind, "chi2": self.chi2, "consistent": not self.inconsistency, "constants": rows}


def described_constants(kind: Literal["lateral", "transversal"]) -> dict[str, float]:
    """Return the robot description's constants of a motor, the starting point of its identification.

    By the names and in the units of `PRIORS`. Speeds, peak and friction are the robot description's.
    """
    motor = load_description().motors[0 if kind == "lateral" else 1]
    return {
        "saturation": 18.0, "peak": motor.peak_torque, "cutoff_speed": motor.cutoff_speed,
        "no_load_speed": motor.no_load_speed, "fade_start": OVERSPEED_START, "fade_end": OVERSPEED_END,
        "friction": motor.coulomb_friction, "latency": 1.0e-3, "time_constant": 1.0e-3,
    }  # fmt: skip


def characterise_motor(
    bench: Bench, kind: Literal["lateral", "transversal"] = "transversal", torque_noise: float = 0.1
) -> Actuator:
    """Identify limits, friction and latency of a motor from a bench recording by least squares.

    kind: motor whose described constants are the prior's means. torque_noise [N m]: standard deviation of the torque
    sensor. Raises InputError: noise that is not positive, a command that never changes, or data that identifies no
    constant.
    """
    check_within("torque noise", np.array([torque_noise]), (1.0e-6, 100.0))
    if np.ptp(bench.command) == 0.0:
        raise InputError("bench: the command must change to determine the motor's constants")
    nominal = described_constants(kind)
    names = list(PRIORS)
    prior_std = np.array([PRIORS[name][0] for name in names])

    def constants(z: np.ndarray) -> dict[str, float]:
        """Convert z (9,), ln(value / described) in standard deviations of the priors, to constants by name."""
        values = {name: nominal[name] * math.exp(p * x) for name, p, x in zip(names, prior_std, z, strict=True)}
        values["no_load_speed"] = max(values["no_load_speed"], 1.001 * values["cutoff_speed"])
        values["fade_end"] = max(values["fade_end"], 1.001 * values["fade_start"])
        return values

    def residuals(z: np.ndarray) -> np.ndarray:
        """Return torque errors over their noise, then z itself, the residuals of the prior, (n + 9,)."""
        return np.concatenate([(bench_torque(constants(z), bench) - bench.torque) / torque_noise, z])

    starts = [np.zeros(len(names))]
    for latency in (-1.5, 1.0):  # far from the minimum a delay and a slow rise have similar effects
        starts.append(np.where(np.array(names) == "latency", latency, 0.0))
    fits = [least_squares(residuals, start, diff_step=1.0e-5, x_scale="jac", max_nfev=100) for start in starts]
    best = min(fits, key=lambda fit: fit.cost)
    errors = best.fun[: len(bench.time)]
    factor = mismatch_factor([errors[bench.test == test][:, None] for test in np.unique(bench.test)])
    std = np.minimum(factor * np.sqrt(np.diag(np.linalg.inv(best.jac.T @ best.jac))), 1.0)
    values = constants(best.x)
    intervals = {
        name: (value * math.exp(-1.96 * p * d), value * math.exp(1.96 * p * d))
        for (name, value), p, d in zip(values.items(), prior_std, std, strict=True)
    }
    unknown = tuple(name for name, d in zip(names, std, strict=True) if d > 0.5)
    deviations = dict(zip(names, map(float, best.x), strict=True))
    result = Actuator(kind, values, intervals, unknown, float(np.mean(errors**2)), deviations)
    if len(unknown) == len(names) and not result.inconsistency:
        raise InputError("bench: the data identifies none of the motor's constants: does the motor turn and push?")
    return result
