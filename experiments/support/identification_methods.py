"""Identification of a robot by SciPy and CMA-ES, to compare them with `jumper_warp.identification` on the same data."""

from __future__ import annotations

import time
from typing import Any, cast

import numpy as np
from scipy.optimize import least_squares

from jumper_warp.identification.identify import identify_by_evolution
from jumper_warp.identification.least_squares import LeastSquares, Point
from jumper_warp.identification.motions import NoiseLevels
from jumper_warp.identification.parameters import ParameterSet
from jumper_warp.identification.replay import MotionReplay
from jumper_warp.identification.residuals import MotionResiduals
from support.known_robots import Case, Simulate, prediction_errors


def make_problem(parameters: ParameterSet, case: Case, replay: MotionReplay) -> LeastSquares:
    """Return the least-squares problem of identifying a robot from its motions and weighed mass.

    replay: simulates the motions.
    """
    residuals = [MotionResiduals(motion, parameters, NoiseLevels(), replay.description) for motion in case.motions]
    return LeastSquares(parameters, residuals, replay, [case.mass])


def chi2_at(problem: LeastSquares, point: Point) -> float:
    """Return χ², the mean squared weighted residual [1], at a point (parameters and initial states)."""
    return sum(float(residual @ residual) for residual in problem.residuals(point)) / problem.count


def scipy_fit(problem: LeastSquares, seconds: float) -> Point:
    """Identify the robot by SciPy's trust-region method within `seconds`, and return the best point.

    SciPy uses the problem's Jacobians.
    """
    begin, size, ends = problem.nominal_point(), len(problem.parameters), time.perf_counter() + seconds
    edges = np.cumsum([size, *(len(start) for start in begin.starts)])
    best = (np.inf, begin)

    class OutOfTime(Exception):
        """Raised to end SciPy's search when its time is over."""

    def to_point(x: np.ndarray) -> Point:
        """Split SciPy's variables into normalised parameters and the initial state of each motion."""
        z, *starts = np.split(x.copy(), edges[:-1])
        return Point(z, starts)

    def residuals(x: np.ndarray) -> np.ndarray:
        """Return all residuals of the fit: motions, weighed mass, priors; remember the best point.

        Raises OutOfTime.
        """
        nonlocal best
        point = to_point(x)
        residual = np.concatenate([*problem.residuals(point), [problem.prior_residuals(point.z)[0][0]], x])
        cost = float(residual @ residual)
        if cost < best[0]:
            best = (cost, point)
        if time.perf_counter() > ends:
            raise OutOfTime
        return np.nan_to_num(residual, posinf=1.0e6)

    def jacobian(x: np.ndarray) -> np.ndarray:
        """Return the Jacobian of `residuals` with respect to SciPy's variables, (residuals, variables)."""
        point = to_point(x)
        table = np.zeros((problem.count + 1 + len(x), len(x)))
        row = 0
        for motion, start, first in zip(problem.motions, point.starts, edges, strict=False):
            block = motion.linearise(problem.replay, point.z, start).jacobian
            rows = table[row : row + len(block)]
            rows[:, :size], rows[:, first : first + len(start)] = block[:, :size], block[:, size:]
            row += len(block)
        table[row, :size] = problem.prior_residuals(point.z)[0][1]
        table[row + 1 :] = np.eye(len(x))
        return table

    low, high = problem.parameters.bounds()
    wide = np.full(edges[-1] - size, np.inf)
    inside = begin.z + 0.2 * (begin.z <= low)  # its trust region shrinks at bounds
    try:
        least_squares(
            residuals, np.concatenate([inside, *begin.starts]), cast(Any, jacobian),
            (np.concatenate([low, -wide]), np.concatenate([high, wide])),
        )  # fmt: skip
    except OutOfTime:
        pass
    return best[1]


def compare_methods(parameters: ParameterSet, case: Case, replay: MotionReplay, ours: Simulate, seconds: float) -> dict:
    """Identify a robot by CMA-ES and by SciPy, each for `seconds`; return χ² and prediction errors.

    Errors are those of the held-out jump [deg], [mm].
    replay: simulates the motions for SciPy; ours: simulates a plan, for the predictions.
    """
    problem = make_problem(parameters, case, replay)
    evolved = identify_by_evolution(case.motions, parameters, prior_measurements=[case.mass], max_seconds=seconds)
    points = {"cma": Point(evolved.z, list(evolved.initial_states)), "scipy": scipy_fit(problem, seconds)}
    metrics = {"methods_wall_s": seconds, "cma_million_world_steps": evolved.effort.world_steps / 1.0e6}
    for name, point in points.items():
        angle, height = prediction_errors(case, parameters.robots(point.z[None]), ours)
        metrics |= {
            f"{name}_held_out_deg": angle,
            f"{name}_held_out_mm": height,
            f"{name}_chi2": chi2_at(problem, point),
        }
    return metrics
