"""χ² tests of a fit: of the residuals by channel and motion, and of each sensor's agreement with all others.

If the model and the noise levels are right, residuals divided by the noise have a mean square (χ²) near 1. A larger one
reveals a wrong model, unit or sign; a sensor that disagrees with the others reveals a faulty sensor or a fit in a wrong
local minimum. P is the number of parameters, z: parameters in standard deviations of their priors, whose own Fisher
information is therefore the identity matrix.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.special import chdtri

from jumper_warp.identification.least_squares import LeastSquares, NormalEquations
from jumper_warp.identification.residuals import MotionResiduals
from jumper_warp.identification.uncertainty import autocorrelation
from jumper_warp.robot.description import MOTOR_JOINTS

FAMILY_LEVEL = 0.01
"""[1] Probability that at least one test of an identification rejects although the model is right."""
COMPARABLE = 10.0
"""[1] Fisher information, over the prior's, that a sensor and the others need about a combination of parameters."""


@dataclass(frozen=True)
class FitTest:
    """Result of a χ² test of whether noise explains a motion's residuals, or how one sensor differs from the others."""

    motion: str
    channel: str  # empty: all channels of the motion; "parameters by ...": of a sensor, compared with all others
    chi2: float  # [1] Mean squared residual over the noise, or difference of parameters over its standard deviation
    limit: float  # [1] χ² above which the test rejects
    correlation: float  # [1] Factor by which measured correlations of the residuals raise the variance; 1: none

    @property
    def passed(self) -> bool:
        """Whether the test does not reject the fit: χ² is at most its limit."""
        return self.chi2 <= self.limit


def chi2_limit(count: int, fitted: float, correlation: float, level: float) -> float:
    """Return the limit that the mean square of residuals (χ²) of a correct model exceeds with probability `level`.

    χ² is the mean square of `count` normal residuals of variance 1, of which the fit determines `fitted` (trace of the
    hat matrix). Correlated residuals act like count / correlation independent ones. Fitted values lower the expected
    sum of squares from `count` to count - fitted.
    """
    freedom = max(count - fitted, 1.0)
    effective = max(freedom / correlation, 1.0)
    return float(chdtri(effective, level)) / effective * freedom / count


def variance_factor(columns: Sequence[np.ndarray]) -> float:
    """Return the factor by which correlations within series of residuals increase the variance of their χ².

    It is 1 + 2 Σ ρ² over lags (Bartlett 1946), with the measured autocorrelation ρ up to the first lag where it is
    within three standard deviations of 0. columns: series of equal variance, one per sensor, (n,) each.
    """
    correlation = autocorrelation(columns)
    return 1.0 + 2.0 * float(np.sum(correlation**2))


class Sensor(NamedTuple):
    """Sensor of one motor or one channel of the base in one motion, with Fisher information and score of its data."""

    motion: MotionResiduals
    name: str  # such as "BL_outer" or "position"
    information: np.ndarray  # (P, P) Fisher information about the normalised parameters, without priors
    score: np.ndarray  # (P,) gradient of half the sensor's cost


def sensor_columns(motion: MotionResiduals) -> dict[str, list[int]]:
    """Return which columns of a motion's measurements belong to each sensor, by its name."""
    columns: dict[str, list[int]] = {}
    for name, span in motion.channels:
        indices = range(*span.indices(motion.valid.shape[1]))
        names = MOTOR_JOINTS if len(indices) == len(MOTOR_JOINTS) else len(indices) * (name,)
        for sensor, column in zip(names, indices, strict=True):
            if motion.valid[:, column].any():
                columns.setdefault(sensor, []).append(column)
    return columns


def sensors(problem: LeastSquares, normal: NormalEquations) -> list[Sensor]:
    """Return the sensors of all motions, with Fisher information and score of their data; normal: normal equations."""
    result = []
    for i, motion in enumerate(problem.motions):
        column_of = np.nonzero(motion.valid)[1]
        for name, columns in sensor_columns(motion).items():
            result.append(Sensor(motion, name, *normal.of_rows(i, np.isin(column_of, columns))))
    return result


def test_level(problem: LeastSquares) -> float:
    """Return the false-alarm probability of each single test of a fit, for `FAMILY_LEVEL` over all tests (Šidák).

    With many tests at 1 % each, a right model would often fail one of them. The level is 1 - (1 - FAMILY_LEVEL)^(1/n).
    """
    count = len(problem.motions) + sum(len(sensor_columns(motion)) for motion in problem.motions)
    count += sum(motion.valid[:, span].any() for motion in problem.motions for _, span in motion.channels)
    return -math.expm1(math.log1p(-FAMILY_LEVEL) / count)


def parameter_tests(
    problem: LeastSquares, normal: NormalEquations, mismatch: float = 1.0
) -> list[tuple[Sensor, FitTest]]:
    """Test for each sensor whether its data imply the same parameters as all other data (Rao's score test).

    At the fit the scores of all sensors and the prior cancel. The score of a sensor with information I has the
    covariance I - I C I, where C is the covariance of the parameters. Combinations of parameters below `COMPARABLE` are
    left out, and sensors without any others. normal: normal equations at the fit. mismatch: factor on standard
    deviations by correlated residuals.
    """
    covariance = np.linalg.inv(normal.information() + np.eye(len(normal.gradient)))
    tests = []
    level = test_level(problem)
    for sensor in sensors(problem, normal):
        information = sensor.information
        variance, vectors = np.linalg.eigh(information - information @ covariance @ information)
        known = variance > COMPARABLE
        if rank := int(known.sum()):
            squares = (vectors.T @ sensor.score)[known] ** 2 / variance[known]
            limit = chi2_limit(rank, 0.0, 1.0, level)
            chi2 = float(np.mean(squares)) / mismatch**2
            name = f"parameters by {sensor.name}"
            tests.append((sensor, FitTest(sensor.motion.motion.name, name, chi2, limit, mismatch**2)))
    return tests


def contradictions(problem: LeastSquares, normal: NormalEquations) -> list[Sensor]:
    """Return the sensors whose data contradict the fitted parameters, those of motions on the ground first.

    The search tries to leave the fit's minimum by dropping a sensor. It tries those on the ground first, since wrong
    local minima come from contacts, which motions with a fixed base do not have. Of each kind, the sensor with the
    largest χ² over its limit is first. Deviations are not divided by the mismatch, unlike in the reported tests. This
    test is therefore stricter: a false alarm only costs a further start, while a missed contradiction may leave the fit
    in a wrong minimum. normal: normal equations at the fit.
    """
    failed = [(sensor, test) for sensor, test in parameter_tests(problem, normal) if not test.passed]
    failed.sort(key=lambda pair: (not pair[0].motion.free, pair[1].limit / pair[1].chi2))
    return [sensor for sensor, _ in failed]


def without(normal: NormalEquations, sensor: Sensor) -> np.ndarray:
    """Return the change of the fitted parameters (P,) if a sensor were left out of the fit, to first order.

    It is a Gauss-Newton step: at the fit all gradients add up to 0, so that those of the others are minus the score.
    """
    return np.linalg.solve(normal.information() + np.eye(len(sensor.score)) - sensor.information, sensor.score)


def residual_tests(problem: LeastSquares, normal: NormalEquations) -> list[FitTest]:
    """Test the residuals of each channel of each motion, and of each motion; normal: normal equations at the fit."""
    level = test_level(problem)
    size = len(problem.parameters)
    covariance = np.linalg.inv(normal.information() + np.eye(size))
    tests = []
    parts = zip(problem.motions, normal.linearised, normal.start_matrices, normal.cross_matrices, strict=True)
    for motion, linear, start_matrix, cross in parts:
        start_jacobian = linear.jacobian[:, size:]
        marginal = linear.jacobian[:, :size] - start_jacobian @ np.linalg.solve(start_matrix, cross.T)
        leverage = np.sum((marginal @ covariance) * marginal, axis=1)
        leverage += np.sum((start_jacobian @ np.linalg.inv(start_matrix)) * start_jacobian, axis=1)
        tables = np.full((2, *motion.valid.shape), math.nan)
        tables[:, motion.valid] = linear.residual, leverage
        rows = []  # by channel: sum of squares, number of values, number of fitted values, variance factor
        for name, columns in motion.channels:
            values = tables[:, :, columns]
            valid = motion.valid[:, columns]
            if not valid.any():
                continue
            series = [values[0, valid[:, i], i] for i in range(valid.shape[1])]
            squares = float(np.nansum(values[0] ** 2))
            fitted = float(np.nansum(values[1]))
            count = int(valid.sum())
            factor = variance_factor(series)
            rows.append((squares, count, fitted, factor * count))
            limit = chi2_limit(count, fitted, factor, level)
            tests.append(FitTest(motion.motion.name, name, squares / count, limit, factor))
        squares, count, fitted, weighed = (sum(column) for column in zip(*rows, strict=True))
        limit = chi2_limit(count, fitted, weighed / count, level)
        tests.append(FitTest(motion.motion.name, "", squares / count, limit, weighed / count))
    return tests
