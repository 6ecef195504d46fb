"""Identification by an evolution strategy (CMA-ES): no derivatives, many more worlds."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from jumper_warp.identification.descent import Descent
from jumper_warp.identification.findings import Identification, Step
from jumper_warp.identification.identify import result
from jumper_warp.identification.least_squares import Knowledge, LeastSquares, Point
from jumper_warp.identification.motions import Motion
from jumper_warp.identification.parameters import ParameterSet
from jumper_warp.identification.replay import Replay
from jumper_warp.identification.residuals import MotionResiduals, NoiseLevels
from jumper_warp.robot.description import RobotDescription
from jumper_warp.utils.errors import InputError

POPULATION = 128
BEGIN = 0.3
"""First deviation of the search, in deviations of the priors."""


def identify_by_evolution(
    motions: Sequence[Motion],
    parameters: ParameterSet,
    *,
    noise: NoiseLevels | None = None,
    knowledge: Sequence[Knowledge] = (),
    dt: float | None = None,
    description: RobotDescription | None = None,
    max_seconds: float = 60.0,
    population: int = POPULATION,
    seed: int = 0,
    device: Any = None,
    threads: int | None = None,
) -> Identification:
    """Return what CMA-ES finds in so many seconds; arguments as of `identify`. Motions start as their first rows say.

    Raises InputError: as `identify`, or `cma` is not installed.
    """
    try:
        import cma
    except ImportError:
        raise InputError("CMA-ES needs the package cma, which is not installed: pip install cma") from None
    if not motions or not max_seconds > 0.0 or population < 4:
        raise InputError("evolution needs motions, a time above 0 s and a population of at least 4")
    replay = Replay(description=description, device=device, threads=threads)
    whole = [MotionResiduals(motion, parameters, noise or NoiseLevels(), replay.description, dt) for motion in motions]
    problem = LeastSquares(parameters, whole, replay, knowledge)
    point, descent = problem.expected(), Descent(replay)
    low, high = parameters.bounds()
    options = {"popsize": population, "seed": seed + 1, "verbose": -9, "bounds": [low, high]}
    search = cma.CMAEvolutionStrategy(point.z, BEGIN, options)
    starts = [np.repeat(start[None], population, axis=0) for start in point.starts]
    best, cost = point.z, np.inf
    while descent.spent()[0] < max_seconds and not search.stop():
        candidates = np.array(search.ask())
        costs = problem.costs(candidates, starts)
        search.tell(list(candidates), list(np.where(np.isfinite(costs), costs, 1.0e12)))
        if costs.min() < cost:
            best, cost = candidates[int(np.argmin(costs))], float(costs.min())
        seconds, _, count = descent.spent()
        descent.steps.append(Step(0, cost / problem.count, 0.0, count, seconds))
    point = Point(np.clip(best, low, high), point.starts)
    return result(problem, point, problem.normal(point), descent)
