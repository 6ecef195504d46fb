"""Result of an identification: values, intervals, and the fit of each motion and channel."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from jumper_warp.identification import uncertainty
from jumper_warp.identification.consistency import FitTest, parameter_tests, residual_tests
from jumper_warp.identification.least_squares import FRICTION, FRICTION_MOVES, LeastSquares, NormalEquations, Point
from jumper_warp.identification.parameters import ParameterSet, PriorMeasurement
from jumper_warp.identification.residuals import MotionResiduals
from jumper_warp.robot.values import RobotValues
from jumper_warp.utils.errors import InputError

CONFIDENCE = 1.959964  # Standard deviations on either side of a 95 % interval
LARGEST_CHI2 = 10.0
"""χ² above which a warning is given; simulations with other physics but right base and units give 3 to 5."""
SAME_COST = 5.0
"""Difference of the costs (of minus twice the log-likelihoods) of two starts below which they agree: contacts in other
physics steps change the cost at a minimum by up to 4."""
LARGEST_PRIOR_ERROR = 3.0
"""Standard deviations between a prior measurement and the identified robot above which a warning is given."""


@dataclass(frozen=True)
class DescentStep:
    """Log entry of one optimisation step: cost, damping and effort so far."""

    stage: int  # number of the stage, from 1
    chi2: float  # [1] Cost over the number of measured values
    damping: float  # [1] Levenberg-Marquardt damping of the step; infinite if no step lowered the cost
    world_steps: int  # physics steps of all worlds so far
    seconds: float  # [s] Wall time so far


class Effort(NamedTuple):
    """Computing time and physics steps that an optimisation took."""

    seconds: float  # [s] wall time
    cpu_seconds: float  # [s] CPU time of all threads
    world_steps: int  # physics steps, summed over worlds


@dataclass(frozen=True)
class Fit:
    """Measures of how well the simulation fits the measurements in one channel of one motion."""

    motion: str
    channel: str
    chi2: float  # [1] Mean squared residual over the noise
    nominal_chi2: float  # [1] χ² of the described robot at the nominal initial state
    rms: float  # root mean square error [SI unit of the channel]


class Minimum(NamedTuple):
    """Local minimum of the cost that one start of the optimisation ended in."""

    point: Point
    normal: NormalEquations  # at the point


@dataclass(frozen=True)
class Start:
    """Comparison of the minimum from one start of the optimisation with the best one, by cost and parameters.

    Different starts that end in one minimum show that it is not a local one.
    """

    excess: float  # [1] Cost above that of the best start, over χ² if that is above 1
    difference: float
    """Largest difference of an identified parameter from the result, in standard deviations of the result."""


def excess_costs(problem: LeastSquares, minima: Sequence[Minimum]) -> np.ndarray:
    """Return each minimum's cost above that of the first, best one (K,), divided by the best one's χ² if above 1."""
    costs = np.array([minimum.normal.cost for minimum in minima])
    return (costs - costs[0]) / problem.scale(minima[0].normal) if minima else costs


def starts_agree(excess: Sequence[float] | np.ndarray) -> bool:
    """Return whether the second-best start confirms the best: its cost is higher by less than `SAME_COST`."""
    return len(excess) > 1 and excess[1] < SAME_COST


@dataclass(frozen=True)
class Identification:
    """Result of an identification of P parameters: estimate, uncertainty and fit."""

    parameters: ParameterSet
    z: np.ndarray  # (P,) Identified parameters, normalised
    covariance: np.ndarray  # (P, P) Covariance of z from noise and priors alone
    mismatch: float  # [1] Smallest factor by which the model's errors widen all intervals; 1 if the model fits
    systematic: np.ndarray
    """(P,) Standard deviations of z from contradictions between channels and motions; 0 if the model fits."""
    spread: np.ndarray
    """(P,) Standard deviations of z between the minima of all starts, and between paws that stick and slip, weighed by
    likelihood."""
    starts: tuple[Start, ...]  # result of each start of the optimisation, best first
    tests: tuple[FitTest, ...]  # tests of the fit of each channel of each motion, and of each motion
    chi2: float  # [1] Mean squared residual of the data over the noise
    nominal_chi2: float  # [1] χ² of the described robot at the nominal initial states
    count: int  # number of measured values
    fits: tuple[Fit, ...]  # fit of each channel of each motion
    directions: tuple[uncertainty.Direction, ...]  # combinations of parameters that the data does not determine
    steps: tuple[DescentStep, ...]
    dt: float  # [s] Physics step
    effort: Effort
    prior_measurements: tuple[PriorMeasurement, ...]  # measurements of the robot other than motions, such as its mass
    motions: tuple[MotionResiduals, ...]
    initial_states: tuple[np.ndarray, ...]  # identified coordinates (I,) of each motion's initial state

    @property
    def values(self) -> np.ndarray:
        """Identified values of all parameters, (P,), each in its unit."""
        return self.parameters.values(self.z)

    @property
    def std(self) -> np.ndarray:
        """Standard deviations (P,) of normalised parameters, at most 1 (prior): noise, model errors, other minima."""
        noise = self.mismatch * np.sqrt(np.diag(self.covariance))
        return np.minimum(np.sqrt(noise**2 + self.systematic**2 + self.spread**2), 1.0)

    @property
    def intervals(self) -> np.ndarray:
        """95 % intervals of all parameters (lower, upper), each in its unit, within the bounds, (P, 2)."""
        low, high = self.parameters.bounds()
        reach = CONFIDENCE * self.std
        edges = (np.clip(self.z - reach, low, high), np.clip(self.z + reach, low, high))
        return np.stack([self.parameters.values(edge) for edge in edges], axis=1)

    @property
    def identified(self) -> np.ndarray:
        """Whether the data determines each parameter: its standard deviation is below half the prior's, (P,) bool."""
        return self.std < 0.5

    @property
    def starts_agree(self) -> bool | None:
        """Whether the best two starting points led to minima of the same cost; None if there was only one."""
        return starts_agree([start.excess for start in self.starts]) if len(self.starts) > 1 else None

    @property
    def consistent(self) -> bool:
        """Whether the fit passes all tests, and the best two starting points, if used, led to the same cost."""
        return self.starts_agree is not False and all(test.passed for test in self.tests)

    @property
    def inconsistency(self) -> str:
        """Reasons why the fit is not consistent, one line; empty if it is."""
        failed = sorted((test for test in self.tests if not test.passed), key=lambda test: test.limit / test.chi2)
        reasons = [
            f"{test.motion} {test.channel or 'in all channels'} χ² {test.chi2:.4g} above {test.limit:.4g}"
            for test in failed[:3]
        ]
        if len(failed) > 3:
            reasons.append(f"{len(failed) - 3} more")
        if self.starts_agree is False:
            reasons.append(f"no two of {len(self.starts)} starts agree")
        return ", ".join(reasons)

    @property
    def warnings(self) -> tuple[str, ...]:
        """Warnings about motions or prior measurements that do not fit, one line each, with the likely cause."""
        lines = []
        if not self.chi2 <= LARGEST_CHI2:
            worst = max(self.fits, key=lambda fit: fit.chi2)
            base = next(motion.motion.base for motion in self.motions if motion.motion.name == worst.motion)
            hint = {
                "free": "free on the ground; if the robot hung from a stand: --base fixed",
                "fixed": "fixed; if the robot was on the ground: --base free",
            }[base]
            lines.append(
                f"χ² {self.chi2:.4g} is far above 1, do not trust the result: {worst.motion} fits worst "
                f"({worst.channel} {worst.chi2:.4g}), its base is assumed {hint}; else check signs, units, gains and "
                "torque limit"
            )
        for prior in self.prior_measurements:
            identified = float(prior.measure(self.robots())[0])
            error = abs(identified - prior.value) / prior.std
            if error > LARGEST_PRIOR_ERROR:
                lines.append(
                    f"{prior.name} is given as {prior.value:.5g} ± {prior.std:.2g} but found as {identified:.5g}, "
                    f"{error:.1f} deviations apart: check it, the intervals are invalid if it is wrong"
                )
        return tuple(lines)

    def robots(self, count: int = 1) -> RobotValues:
        """Return `count` copies of the identified robot, one row for each world."""
        return self.parameters.robots(np.repeat(self.z[None], count, axis=0), self.motions[0].description)


class ChannelError(NamedTuple):
    """Differences between measured and simulated values in one channel of one motion."""

    motion: str  # name of the motion
    channel: str  # name of the channel
    cost: float  # [1] sum of squared residuals over the noise
    count: int  # number of measured values
    rms: float  # root mean square error [SI unit of the channel]


def channel_errors(problem: LeastSquares, point: Point) -> list[ChannelError]:
    """Return how far simulation and measurement differ at a point, for each motion and measured channel."""
    errors = []
    for motion, start in zip(problem.motions, point.starts, strict=True):
        table = np.full(motion.valid.shape, math.nan)
        table[motion.valid] = motion.residuals(problem.replay, point.z[None], start[None])[:, 0]
        for name, columns in motion.channels:
            values = table[:, columns][motion.valid[:, columns]]
            if len(values):
                rms = math.sqrt(float(np.mean(values**2))) * motion.sigma[columns][0]
                errors.append(ChannelError(motion.motion.name, name, float(values @ values), len(values), rms))
    return errors


def trapped_spread(problem: LeastSquares, minimum: Minimum, covariance: np.ndarray) -> np.ndarray:
    """Return additional standard deviations (P,) of normalised parameters, for paws that may also stick.

    covariance: of the linear model, (P, P).
    """
    point, normal = minimum
    if FRICTION not in problem.parameters.names:
        return np.zeros(len(point.z))
    index = problem.parameters.names.index(FRICTION)
    points, costs = problem.scan(point, normal, index, FRICTION_MOVES)
    moves = np.array([moved.z[index] - point.z[index] for moved in points])
    variance = covariance[index, index]
    missed = uncertainty.trapped_variance(moves, (costs - normal.cost) / problem.scale(normal), math.sqrt(variance))
    return math.sqrt(missed) * np.abs(covariance[:, index]) / variance


def summarise(
    problem: LeastSquares, minima: Sequence[Minimum], steps: Sequence[DescentStep], effort: Callable[[], Effort]
) -> Identification:
    """Collect the results of an identification from its minima: estimate, uncertainty and fit.

    minima: of all starts, best first. steps: log of the optimisation. effort: called after all evaluations. Raises
    InputError: the fit is consistent and identifies no parameter, as with a robot that does not move.
    """
    point, normal = minima[0]
    nominal, errors = (channel_errors(problem, at) for at in (problem.nominal_point(), point))
    fits = [
        Fit(error.motion, error.channel, error.cost / error.count, old.cost / old.count, error.rms)
        for error, old in zip(errors, nominal, strict=True)
    ]
    information = normal.information()
    tables = []
    for motion, residual in zip(problem.motions, problem.residuals(point), strict=True):
        table = np.full(motion.valid.shape, math.nan)
        table[motion.valid] = residual
        tables.append(table)
    covariance = np.linalg.inv(information + np.eye(len(information)))
    mismatch = uncertainty.mismatch_factor(tables)
    columns = [np.nonzero(motion.valid)[1] for motion in problem.motions]
    systematic = uncertainty.systematic_std(normal, columns, covariance) if mismatch > 1.0 else np.zeros(len(point.z))
    excess = excess_costs(problem, minima)
    distance = np.array([minimum.point.z - point.z for minimum in minima])
    weight = np.exp(-0.5 * excess) / np.sum(np.exp(-0.5 * excess))
    result = Identification(
        parameters=problem.parameters,
        z=point.z,
        covariance=covariance,
        mismatch=mismatch,
        systematic=systematic,
        spread=np.sqrt(weight @ distance**2 + trapped_spread(problem, minima[0], covariance) ** 2),
        starts=(),
        tests=(*residual_tests(problem, normal), *(t for _, t in parameter_tests(problem, normal, mismatch))),
        chi2=sum(error.cost for error in errors) / problem.count,
        nominal_chi2=sum(error.cost for error in nominal) / problem.count,
        count=problem.count,
        fits=tuple(fits),
        directions=uncertainty.weak_directions(problem.parameters, information),
        steps=tuple(steps),
        dt=max(motion.dt for motion in problem.motions),
        effort=effort(),
        prior_measurements=tuple(problem.prior_measurements),
        motions=tuple(problem.motions),
        initial_states=tuple(point.starts),
    )
    far = np.max(np.abs(distance / result.std), axis=1, where=result.identified, initial=0.0)
    starts = tuple(Start(float(e), float(d)) for e, d in zip(excess, far, strict=True))
    result = replace(result, starts=starts)
    if result.consistent and not result.identified.any():
        reasons = "; ".join(direction.words for direction in result.directions[:2])
        raise InputError(f"the motions identify none of {len(result.parameters)} parameters: {reasons}")
    return result
