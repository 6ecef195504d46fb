"""What an identification found: values, intervals, and how well the motions are explained."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from jumper_warp.identification.least_squares import Knowledge
from jumper_warp.identification.parameters import ParameterSet
from jumper_warp.identification.residuals import MotionResiduals
from jumper_warp.identification.uncertainty import Direction
from jumper_warp.robot.overlay import RobotOverlay, overlay_of
from jumper_warp.robot.values import RobotValues

RATIO_ROWS = {
    "link_mass": "link_mass", "kp": "gains", "kd": "damping_gains", "armature": "armature",
    "no_load_speed": "no_load_speed", "cutoff_speed": "cutoff_speed",
}  # fmt: skip
"""Row of `RandomizationCfg` that scales a quantity."""
CONFIDENCE = 1.959964
"""Deviations on either side of a 95 % interval."""
FAR = 10.0
"""χ² above which the found values are not to be trusted: other physics, where base and units are right, make 3 to 5."""
APART = 3.0
"""Deviations between what is known of the robot and what is found, above which one of both is wrong."""


@dataclass(frozen=True)
class Step:
    """One step of the optimisation."""

    stage: int
    chi2: float
    """Mean squared weighed residual, with knowledge and priors."""
    damping: float
    world_steps: int
    """Physics steps of all worlds up to here."""
    seconds: float


@dataclass(frozen=True)
class Fit:
    """How well one channel of one motion is explained."""

    motion: str
    channel: str
    chi2: float
    nominal_chi2: float
    """Of the described robot from the expected start."""
    rms: float
    """[SI unit of the channel]"""


@dataclass(frozen=True)
class Identification:
    """What was found."""

    parameters: ParameterSet
    z: np.ndarray
    """(P,) normalised."""
    covariance: np.ndarray
    """(P, P) normalised, from noise and priors alone."""
    mismatch: float
    """[1] Factor by which the model's errors widen all intervals at least, from 1."""
    systematic: np.ndarray
    """(P,) Standard deviations, normalised, from how channels and motions contradict each other; 0 if the model
    explains them."""
    chi2: float
    """Mean squared weighed residual of the data."""
    nominal_chi2: float
    """Of the described robot from the expected starts."""
    count: int
    """Number of measured values."""
    fits: tuple[Fit, ...]
    directions: tuple[Direction, ...]
    """Combinations of parameters of which the data says little."""
    steps: tuple[Step, ...]
    dt: float
    """[s] Physics step."""
    seconds: float
    cpu_seconds: float
    world_steps: int
    """Physics steps of all worlds."""
    knowledge: tuple[Knowledge, ...]
    """Of the robot besides the motions."""
    motions: tuple[MotionResiduals, ...]
    starts: tuple[np.ndarray, ...]

    @property
    def values(self) -> np.ndarray:
        """Values [unit of each parameter], (P,)."""
        return self.parameters.values(self.z)

    @property
    def deviations(self) -> np.ndarray:
        """Standard deviations in deviations of the prior, errors of the model included, at most 1, (P,)."""
        noise = self.mismatch * np.sqrt(np.diag(self.covariance))
        return np.minimum(np.hypot(noise, self.systematic), 1.0)

    @property
    def intervals(self) -> np.ndarray:
        """95 % intervals [unit of each parameter], within the bounds, (P, 2)."""
        low, high = self.parameters.bounds()
        reach = CONFIDENCE * self.deviations
        edges = (np.clip(self.z - reach, low, high), np.clip(self.z + reach, low, high))
        return np.stack([self.parameters.values(edge) for edge in edges], axis=1)

    @property
    def identified(self) -> np.ndarray:
        """Whether the data at least halves what the prior leaves open, (P,) bool."""
        return self.deviations < 0.5

    @property
    def doubts(self) -> tuple[str, ...]:
        """One line for each thing that does not fit, with what to look at; none if motions and knowledge agree."""
        lines = []
        if not self.chi2 <= FAR:
            worst = max(self.fits, key=lambda fit: fit.chi2)
            base = next(motion.motion.base for motion in self.motions if motion.motion.name == worst.motion)
            other = {
                "free": "free on the ground; if the robot hung from a stand: --base fixed",
                "fixed": "fixed; if the robot was on the ground: --base free",
            }[base]
            lines.append(
                f"χ² {self.chi2:.4g} is far above 1, do not trust what was found: {worst.motion} fits worst "
                f"({worst.channel} {worst.chi2:.4g}), its base is taken as {other}; else check signs, units, gains and "
                "torque limit"
            )
        for known in self.knowledge:
            found = float(known.measure(self.robots())[0])
            apart = abs(found - known.value) / known.deviation
            if apart > APART:
                lines.append(
                    f"{known.name} is given as {known.value:.5g} ± {known.deviation:.2g} but found as {found:.5g}, "
                    f"{apart:.1f} deviations apart: check it, intervals do not hold if it is wrong"
                )
        return tuple(lines)

    def overlay(self, source: str = "") -> RobotOverlay:
        """Return the identified robot as an overlay, with the intervals as ranges of randomisation."""
        quantities = tuple(dict.fromkeys(parameter.quantity for parameter in self.parameters))
        return overlay_of(self.robots(), quantities, randomization=randomization_ranges(self), source=source)

    def robots(self, count: int = 1) -> RobotValues:
        """Return the identified robot, `count` times."""
        return self.parameters.robots(np.repeat(self.z[None], count, axis=0))


def randomization_ranges(found: Identification) -> dict[str, tuple[float, float]]:
    """Return rows of `RandomizationCfg` that hold all intervals, relative to the identified values."""
    rows: dict[str, tuple[float, float]] = {}

    def widen(row: str, low: float, high: float) -> None:
        old = rows.get(row, (low, high))
        rows[row] = (min(low, old[0]), max(high, old[1]))

    for parameter, value, (low, high) in zip(found.parameters, found.values, found.intervals, strict=True):
        quantity, value, low, high = parameter.quantity, float(value), float(low), float(high)
        if quantity in RATIO_ROWS:
            widen(RATIO_ROWS[quantity], low / value, high / value)
        elif quantity == "base_mass":
            widen("base_mass", low - value, high - value)
        elif quantity == "base_com":
            widen("com_shift", low - value, high - value)
        elif quantity == "offset":
            widen("joint_offset", math.degrees(low - value), math.degrees(high - value))
        elif quantity == "motor_friction":
            widen("motor_friction", low, high)
        elif quantity == "paw_friction":
            widen("dynamic_friction", low, high)
            widen("static_friction", low, high)
        elif quantity == "latency":
            widen("latency", 1.0e3 * low, 1.0e3 * high)
    return rows
