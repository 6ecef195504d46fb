"""Identification of the robot's parameters from recorded motions (paper, Section V-F a).

Unknowns are the parameters and where each motion starts. Residuals are weighed by noise, priors and further knowledge
count like measurements, and the sum of squares is minimised by Levenberg-Marquardt over parallel worlds, in stages:
the motions are first cut into short pieces with starts of their own, whose residuals are nearly linear in the
parameters, and then taken as wholes.
"""

from __future__ import annotations

import itertools
import math
import time
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import warp as wp

from jumper_warp.optim.least_squares import DAMPINGS, Knowledge, LeastSquares, Normal, Point
from jumper_warp.optim.motions import Motion
from jumper_warp.optim.parameters import ParameterSet
from jumper_warp.optim.replay import Replay
from jumper_warp.optim.residuals import MotionResiduals, NoiseLevels
from jumper_warp.optim.uncertainty import Direction, mismatch_factor, weak_directions
from jumper_warp.robot.description import RobotDescription, load_description
from jumper_warp.robot.overlay import RobotOverlay, overlay_of
from jumper_warp.robot.values import LINK_KINDS, RobotValues
from jumper_warp.utils.checks import check_positive
from jumper_warp.utils.errors import InputError

PIECES = (0.25,)
"""[s] Lengths of the pieces of the stages before the last."""
WORTH_A_STEP = 0.1
"""Relative decrease of the cost below which a stage ends, unless it is the last."""
WHOLE = ((True, 10.0), (False, 1.0), (False, 1.0))
"""Stages of whole motions: whether they are robust, and the decrease of the cost, in mean squared residuals, that ends
them: 1 is what one deviation costs."""
MOST_STEPS = (5, 25)
"""Of each stage but the last, and of the last."""
RATIO_ROWS = {
    "link_mass": "link_mass", "kp": "gains", "kd": "damping_gains", "armature": "armature",
    "no_load_speed": "no_load_speed", "cutoff_speed": "cutoff_speed",
}  # fmt: skip
"""Row of `RandomizationCfg` that scales a quantity."""
CONFIDENCE = 1.959964
"""Deviations on either side of a 95 % interval."""


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
    """[1] Factor by which all intervals are wider than noise alone makes them, at least 1."""
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
    motions: tuple[MotionResiduals, ...]
    starts: tuple[np.ndarray, ...]

    @property
    def values(self) -> np.ndarray:
        """Values [unit of each parameter], (P,)."""
        return self.parameters.values(self.z)

    @property
    def deviations(self) -> np.ndarray:
        """Standard deviations in deviations of the prior, mismatch included, at most 1, (P,)."""
        return np.minimum(self.mismatch * np.sqrt(np.diag(self.covariance)), 1.0)

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


def total_mass(robots: RobotValues, description: RobotDescription | None = None) -> np.ndarray:
    """Return the mass [kg] of N robots, (N,)."""
    robot = load_description() if description is None else description
    leg = np.array([robot.link(f"FL_{kind}").mass for kind in LINK_KINDS])
    return robots.base_mass[:, 0] + 4.0 * robots.link_mass @ leg


def weighed(mass: float, deviation: float = 0.02) -> Knowledge:
    """Return what a scale says [kg]. Raises InputError for a mass or deviation that is not positive."""
    check_positive("weighed mass and its deviation", mass, deviation)
    return Knowledge("total mass", total_mass, mass, deviation)


def identify(
    motions: Sequence[Motion],
    parameters: ParameterSet,
    *,
    noise: NoiseLevels | None = None,
    knowledge: Sequence[Knowledge] = (),
    dt: float | None = None,
    description: RobotDescription | None = None,
    replay: Replay | None = None,
    device: wp.DeviceLike = None,
    threads: int | None = None,
) -> Identification:
    """Return the parameters that explain the motions best.

    Args:
        motions: What was recorded.
        parameters: What is unknown.
        noise: Of the sensors.
        knowledge: Of the robot besides the motions.
        dt: Largest physics step [s], by default 1/480.
        description: Of the nominal robot, by default the project's.
        replay: Worlds of an earlier call, to be used again; its description counts.
        device: Warp device.
        threads: Of a CPU.

    Raises:
        InputError: no motions, motions with gaps, without measurements or that the model cannot follow.
    """
    if not motions:
        raise InputError("there must be at least one motion")
    started, cpu = time.perf_counter(), time.process_time()
    noise = NoiseLevels() if noise is None else noise
    if replay is None:
        replay = Replay(len(parameters) + 37, description=description, device=device, threads=threads)
    before, steps = replay.world_steps, []
    robot = replay.description

    def note(stage: int, problem: LeastSquares, cost: float, damping: float) -> None:
        count = replay.world_steps - before
        steps.append(Step(stage, cost / problem.count, damping, count, time.perf_counter() - started))

    whole = [MotionResiduals(motion, parameters, noise, robot, dt) for motion in motions]
    z = np.zeros(len(parameters))
    for stage, length in enumerate(PIECES):
        pieces = [pieces_of(motion, parameters, noise, robot, dt, length) for motion in motions]
        problem = LeastSquares(parameters, [piece for each in pieces for piece in each], replay, knowledge)
        point, problem.robust = Point(z, problem.expected().starts), True
        for _ in range(MOST_STEPS[0]):
            normal = problem.normal(point)
            point, cost, damping = problem.step(point, normal)
            note(stage, problem, cost, damping)
            if normal.cost - cost < WORTH_A_STEP * normal.cost:
                break
        z = point.z
    problem = LeastSquares(parameters, whole, replay, knowledge)
    nominal = channel_fits(problem, problem.expected())
    best: tuple[float, Point, Normal] | None = None
    point = Point(z, problem.expected().starts)
    for stage, (robust, least) in enumerate(WHOLE, len(PIECES)):
        problem.robust = robust
        for _ in range(MOST_STEPS[1]):
            normal = problem.normal(point)
            point, cost, damping = problem.step(point, normal)
            note(stage, problem, cost, damping)
            if normal.cost - cost < least * cost / problem.count:
                break
        if not robust and (best is None or cost < best[0]):
            best = (cost, point, normal)
        if not robust:  # what friction at rest makes of a start is full of small minima: try again from outside
            point = Point(point.z, problem.expected().starts)
    _, point, normal = best
    return result(problem, point, normal, nominal, steps, (started, cpu, before))


def pieces_of(
    motion: Motion,
    parameters: ParameterSet,
    noise: NoiseLevels,
    description: RobotDescription,
    dt: float | None,
    length: float,
) -> list[MotionResiduals]:
    """Return a motion in pieces of about a length [s], those without measurements left out."""
    rows = len(motion.time)
    number = max(1, min(round(motion.duration / length), rows // 4))
    edges = [round(rows * i / number) for i in range(number + 1)]
    spans = itertools.pairwise(edges)
    return [MotionResiduals(motion, parameters, noise, description, dt, span) for span in spans]


def channel_fits(problem: LeastSquares, point: Point) -> list[tuple[str, str, float, int, float]]:
    """Return (motion, channel, sum of squares, count, root mean square in SI units) of all channels at a point."""
    found = []
    for motion, start in zip(problem.motions, point.starts, strict=True):
        table = np.full(motion.valid.shape, math.nan)
        table[motion.valid] = motion.residuals(problem.replay, point.z[None], start[None])[:, 0]
        for name, columns in motion.channels:
            values = table[:, columns][motion.valid[:, columns]]
            if len(values):
                rms = math.sqrt(float(np.mean(values**2))) * motion.sigma[columns][0]
                found.append((motion.motion.name, name, float(values @ values), len(values), rms))
    return found


def result(
    problem: LeastSquares, point: Point, normal: Normal, nominal: list, steps: list[Step], begun: tuple
) -> Identification:
    """Return what is reported of an optimisation that ended at a point, close to which the normal equations are."""
    started, cpu, before = begun
    fits = channel_fits(problem, point)
    rows = [
        Fit(motion, channel, cost / count, old / count, rms)
        for (motion, channel, cost, count, rms), (_, _, old, _, _) in zip(fits, nominal, strict=True)
    ]
    information = normal.information()
    chi2 = sum(cost for _, _, cost, _, _ in fits) / problem.count
    tables = []
    for motion, start in zip(problem.motions, point.starts, strict=True):
        table = np.full(motion.valid.shape, math.nan)
        table[motion.valid] = motion.residuals(problem.replay, point.z[None], start[None])[:, 0]
        tables.append(table)
    return Identification(
        parameters=problem.parameters,
        z=point.z,
        covariance=np.linalg.inv(information + np.eye(len(information))),
        mismatch=mismatch_factor(tables),
        chi2=chi2,
        nominal_chi2=sum(cost for _, _, cost, _, _ in nominal) / problem.count,
        count=problem.count,
        fits=tuple(rows),
        directions=weak_directions(problem.parameters, information),
        steps=tuple(steps),
        dt=max(motion.dt for motion in problem.motions),
        seconds=time.perf_counter() - started,
        cpu_seconds=time.process_time() - cpu,
        world_steps=problem.replay.world_steps - before,
        motions=tuple(problem.motions),
        starts=tuple(point.starts),
    )


__all__ = ["DAMPINGS", "Identification", "identify", "total_mass", "weighed"]
