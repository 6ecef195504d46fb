"""Other methods of identification, on the same data and the same parallel worlds."""

from __future__ import annotations

import time

import numpy as np
from scipy.optimize import least_squares

from jumper_warp.identification.identify import identify_by_evolution
from jumper_warp.identification.least_squares import LeastSquares, Point
from jumper_warp.identification.motions import NoiseLevels
from jumper_warp.identification.parameters import ParameterSet
from jumper_warp.identification.replay import Replay
from jumper_warp.identification.residuals import MotionResiduals
from support.known_robots import Carry, Case, prediction_errors


def scipy_fit(parameters: ParameterSet, case: Case, replay: Replay, seconds: float) -> Point:
    """Return where SciPy's trust region comes in so many seconds, by differences over the same parallel worlds."""
    whole = [MotionResiduals(motion, parameters, NoiseLevels(), replay.description) for motion in case.motions]
    problem = LeastSquares(parameters, whole, replay, [case.mass])
    point, size, ends = problem.expected(), len(parameters), time.perf_counter() + seconds
    edges = np.cumsum([size, *(len(start) for start in point.starts)])

    class OutOfTime(Exception):
        pass

    best = (np.inf, point)

    def split(x: np.ndarray) -> list[np.ndarray]:
        return np.split(x, edges[:-1])

    def residuals(x: np.ndarray) -> np.ndarray:
        nonlocal best
        z, *starts = split(x)
        rows = [m.residuals(replay, z[None], s[None])[:, 0] for m, s in zip(whole, starts, strict=True)]
        mass = (case.mass.measure(parameters.robots(z)) - case.mass.value) / case.mass.deviation
        found = np.concatenate([*rows, mass, x])
        cost = float(found @ found)
        if cost < best[0]:
            best = (cost, Point(z.copy(), [start.copy() for start in starts]))
        if time.perf_counter() > ends:
            raise OutOfTime
        return np.nan_to_num(found, posinf=1.0e6)

    def jacobian(x: np.ndarray) -> np.ndarray:
        z, *starts = split(x)
        table = np.zeros((problem.count + 1 + len(x), len(x)))
        row = 0
        for i, (motion, start) in enumerate(zip(whole, starts, strict=True)):
            found = motion.linearise(replay, z, start).jacobian
            table[row : row + len(found), :size] = found[:, :size]
            table[row : row + len(found), edges[i] : edges[i + 1]] = found[:, size:]
            row += len(found)
        slopes = problem.known(z)
        table[row, :size] = slopes[0][1]
        table[row + 1 :] = np.eye(len(x))
        return table

    low, high = parameters.bounds()
    wide = np.full(edges[-1] - size, np.inf)
    limits = (np.concatenate([low, -wide]), np.concatenate([high, wide]))
    begin = np.concatenate([point.z, *point.starts])
    begin[:size] += 0.2 * (begin[:size] <= low)  # its trust region shrinks at bounds
    try:
        least_squares(residuals, begin, jacobian, limits)
    except OutOfTime:
        pass
    return best[1]


def compare_methods(parameters: ParameterSet, case: Case, replay: Replay, ours: Carry, seconds: float) -> dict:
    """Return χ² and held-out errors of CMA-ES and SciPy in the time that this project took."""
    evolved = identify_by_evolution(case.motions, parameters, knowledge=[case.mass], max_seconds=seconds)
    trusted = scipy_fit(parameters, case, replay, seconds)
    figures = {}
    for name, point in (("cma", Point(evolved.z, list(evolved.starts))), ("scipy", trusted)):
        robots = parameters.robots(point.z[None])
        angle, height = prediction_errors(case, robots, ours)
        figures |= {f"{name}_held_out_deg": angle, f"{name}_held_out_mm": height}
        figures[f"{name}_chi2"] = chi2_at(parameters, case, replay, point)
    return figures | {"methods_wall_s": seconds, "cma_million_world_steps": evolved.world_steps / 1.0e6}


def chi2_at(parameters: ParameterSet, case: Case, replay: Replay, point: Point) -> float:
    """Return the mean squared weighed residual at a point."""
    whole = [MotionResiduals(motion, parameters, NoiseLevels(), replay.description) for motion in case.motions]
    problem = LeastSquares(parameters, whole, replay)
    return sum(float(found @ found) for found in problem.residuals(point)) / problem.count
