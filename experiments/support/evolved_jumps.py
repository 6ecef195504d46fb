"""Evolution strategies for the jumps that `optim.trajectory` optimises, to compare with."""

from __future__ import annotations

import time
from typing import Any

import numpy as np
import torch

from jumper_warp.trajectory.problem import Problem
from jumper_warp.trajectory.smoothing import BATCH, penalised
from support import takeoff_search

POPULATION = 64
"""Of CMA-ES."""
PENALTY = 100.0
"""[1] Of squared violations, for CMA-ES."""
FEASIBLE = 1.0e-3
"""[1] Largest constraint of a candidate that counts."""


class Clock:
    """Wall and processor time since it was made."""

    def __init__(self) -> None:
        self._wall, self._cpu = time.perf_counter(), time.process_time()

    def __call__(self) -> dict[str, float]:
        """Return both [s]."""
        return {"wall_s": time.perf_counter() - self._wall, "cpu_s": time.process_time() - self._cpu}


def evolve(problem: Problem, begin: np.ndarray, seconds: float, seed: int) -> np.ndarray | None:
    """Return what CMA-ES finds on the same rollouts in so much processor time, from the best of some candidates.

    None where no candidate satisfied the constraints.
    """
    cma = takeoff_search.cma_package()
    clock, real = Clock(), torch.float64 if problem.double else torch.float32
    device = str(problem.rollout(POPULATION).device)

    def worth(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        with torch.no_grad():
            values = problem.evaluate(torch.as_tensor(x, dtype=real, device=device))
        cost = torch.nan_to_num(penalised(values, PENALTY), 10.0, 10.0).clamp_max(10.0)
        fits = values.constraints.amax(1) <= FEASIBLE if values.constraints.shape[1] else torch.ones_like(cost) > 0.0
        return cost.cpu().numpy(), torch.where(fits, values.objective, torch.inf).cpu().numpy()

    costs = np.concatenate([worth(part)[0] for part in np.split(begin, range(BATCH, len(begin), BATCH))])
    first = begin[costs.argmin()]
    search = cma.CMAEvolutionStrategy(
        first, takeoff_search.SIGMA, {"popsize": POPULATION, "seed": seed + 1, "verbose": -9}
    )
    search.inject([first], force=True)
    best, value = first, np.inf
    while clock()["cpu_s"] < seconds:
        drawn_ones = np.array(search.ask())
        inside = np.clip(drawn_ones, -1.0, 1.0)
        cost, feasible = worth(inside)
        if feasible.min() < value:
            best, value = inside[feasible.argmin()], float(feasible.min())
        outside = takeoff_search.OUTSIDE * ((drawn_ones - inside) ** 2).sum(axis=1)
        search.tell(list(drawn_ones), list(cost + outside))
    return best if np.isfinite(value) else None


def search_as_published(device: str | None, generations: int, seed: int) -> dict[str, float]:
    """Return what the search of `distance_limit.py` for the farthest flight finds, without the one from the policy.

    generations: of each of its four searches; 200 / 480 of it when it goes on from the best.
    """
    clock, search = Clock(), takeoff_search
    env = search.env_of_limit(search.NOMINAL, POPULATION, device)
    steps, step = [0], env.step

    def counting(action: torch.Tensor) -> Any:
        steps[0] += env.num_envs
        return step(action)

    env.step = counting
    found = []
    for number in range(4):
        begin = search.random_squat(env, search.NOMINAL, seed + number)
        found.append(search.search(env, search.NOMINAL, begin, search.SIGMA, generations, seed + number))
    best = max(found, key=lambda pair: pair[1])[0]
    further = max(1, round(generations * 200 / 480))
    _, value = search.search(env, search.NOMINAL, best, search.FURTHER_SIGMA, further, seed)
    value = max(value, *(score for _, score in found))
    return {"value": value, "simulated_steps": float(steps[0]), "reverse_steps": 0.0} | clock()
