"""Augmented Lagrangian method with limited-memory BFGS steps in a box, for many starts in parallel.

Every start has its own curvature, step length and multipliers. Step lengths are tried in parallel worlds of one
rollout, together with a few random steps, which cross the kinks of contacts. Nocedal and Wright, Numerical
Optimization, 2nd edition: algorithm 7.4 (two loops) and section 17.4 (augmented Lagrangian).
"""

from __future__ import annotations

import time
from dataclasses import dataclass, field

import numpy as np
import torch

from jumper_warp.trajectory.problem import Problem, Values
from jumper_warp.utils.errors import InputError

LENGTHS = (2.0, 1.0, 0.5, 0.2, 0.06, 0.02)  # [1] step lengths along the direction that are tried in parallel
RANDOM = 2  # random steps by start that are tried in parallel too
MEMORY = 8  # pairs of steps and gradient changes that BFGS keeps
MAX_STEP, MIN_STEP = 0.5, 1.0e-3  # [1] bounds of the largest entry of a step of length 1
OUTER = 15  # iterations between updates of the multipliers
PENALTY, GROWTH, MAX_PENALTY = 20.0, 2.0, 2.0e4
"""[1] Initial weight of squared constraints, its factor if they did not halve since the last update, and its limit."""
FEASIBLE = 1.0e-3  # [1] constraints up to this value count as satisfied


@dataclass
class Progress:
    """Best candidate that an optimisation has found so far from each of its starts, and the optimisation's history."""

    x: np.ndarray  # (starts, n) Best feasible candidate of each start, or the least infeasible one if none was feasible
    objective: np.ndarray  # (starts,) Objective of `x`; infinite if no candidate was feasible
    violation: np.ndarray  # (starts,) Largest constraint of `x`, at least 0
    history: list[dict[str, float]] = field(default_factory=list)
    """By iteration: seconds, world_steps, reverse_steps (see `Problem`) and objective, the lowest feasible one."""

    @property
    def best(self) -> int:
        """Index of the start with the lowest feasible objective, or the smallest violation if none is feasible."""
        return int(np.argmin(np.where(np.isfinite(self.objective), self.objective, 1.0e12 + self.violation)))


def minimise(
    problem: Problem, begin: np.ndarray, *, iterations: int = 100, step: float = 0.1, seed: int = 0
) -> Progress:
    """Minimise a trajectory optimisation problem by the augmented Lagrangian method, from many starts in parallel.

    Returns the best candidates. begin: (starts, n = len(problem.knots)), all entries within ±1. An
    iteration takes one gradient and `len(LENGTHS) + RANDOM` simulations for each start. step [1]: largest entry of the
    first steps. seed: of the random steps. Raises InputError: `begin` has another shape.
    """
    if begin.ndim != 2 or begin.shape[1] != len(problem.knots) or len(begin) < 1:
        raise InputError(f"starts must have shape (starts, {len(problem.knots)}), got {begin.shape}")
    descent = _Descent(problem, begin, step, seed)
    started = time.perf_counter()
    for number in range(iterations):
        descent.iterate(number)
        progress = descent.progress
        progress.history.append(
            {
                "seconds": time.perf_counter() - started,
                "world_steps": float(problem.world_steps),
                "reverse_steps": float(problem.reverse_steps),
                "objective": float(progress.objective.min()),
            }
        )
    return descent.progress


class _Descent:
    """State of an optimisation by the augmented Lagrangian method, for all starts in parallel.

    Shapes: points `x` (starts, n), `step` [1], `penalty` and the last largest `violation` (starts,), multipliers
    (starts, constraints); `pairs` are L-BFGS's past steps, changes of the gradient and inverse products, the oldest
    first; `previous`: point and gradient before the last step.
    """

    def __init__(self, problem: Problem, begin: np.ndarray, step: float, seed: int):
        """Place all starts at `begin` (starts, n), without curvature, multipliers or best points; see `minimise`."""
        real = torch.float64 if problem.double else torch.float32
        self.problem = problem
        device = str(problem.rollout(len(begin)).device)
        self.x = torch.as_tensor(begin, dtype=real, device=device).clamp(-1.0, 1.0)
        self.step = torch.full((len(begin),), step, dtype=real, device=device)
        self.rng = np.random.default_rng(seed)
        self.pairs: list[tuple[torch.Tensor, torch.Tensor, torch.Tensor]] = []
        self.multipliers: torch.Tensor | None = None
        self.penalty = self.x.new_full((len(begin),), PENALTY)
        self.violation = self.x.new_full((len(begin),), torch.inf)
        self.previous: tuple[torch.Tensor, torch.Tensor] | None = None
        self.progress = Progress(begin.copy(), np.full(len(begin), np.inf), np.full(len(begin), np.inf))

    def merit(self, values: Values, repeat: int = 1) -> torch.Tensor:
        """Return the augmented Lagrangian of candidates, the function to minimise, (starts * repeat,).

        A multiplier shifts the point from which a constraint's violation is penalised, so that the minimum satisfies
        the constraints with a finite penalty. repeat: number of candidates by start.
        """
        if self.multipliers is None:
            self.multipliers = self.x.new_zeros(len(self.x), values.constraints.shape[1])
        penalty = self.penalty[:, None].repeat_interleave(repeat, 0)
        shift = self.multipliers.repeat_interleave(repeat, 0) / penalty
        pressed = (values.constraints + shift).clamp_min(0.0)
        return values.objective + 0.5 * (penalty * (pressed.square() - shift.square())).sum(1)

    def iterate(self, number: int) -> None:
        """Take one L-BFGS step of every start; every `OUTER`-th iteration (`number`) also updates the multipliers.

        Each start moves to the best of the tried points if that is better. Its step grows if the longest one was the
        best, and shrinks if a short one or none was.
        """
        values, gradient = self.problem.gradient(self.x, self.merit)
        self._keep_best(self.x, values, 1)
        if number and number % OUTER == 0:
            self._update_multipliers(values)
            values, gradient = self.problem.gradient(self.x, self.merit)
            self.previous = None
        self._add_pair(gradient)
        direction = self._direction(gradient)
        size = direction.abs().amax(1).clamp_min(1.0e-12)
        direction *= torch.minimum(torch.ones_like(size), self.step / size)[:, None]
        lengths = self.x.new_tensor(LENGTHS)
        normal = self.rng.normal(size=(len(self.x), RANDOM, self.x.shape[1]))
        noise = torch.as_tensor(normal, dtype=self.x.dtype, device=self.x.device)
        steps = torch.cat(
            [lengths[None, :, None] * direction[:, None], 0.3 * self.step[:, None, None] * noise + direction[:, None]],
            1,
        )
        count = steps.shape[1]
        tried = (self.x[:, None] + steps).clamp(-1.0, 1.0)
        flat = tried.flatten(0, 1)
        with torch.no_grad():
            tried_values = self.problem.evaluate(flat)
        self._keep_best(flat, tried_values, count)
        merits = self.merit(tried_values, count).unflatten(0, (-1, count))
        merits = torch.where(merits.isnan(), torch.inf, merits)
        best, chosen = merits.min(1)
        better = best < self.merit(values)
        worlds = torch.arange(len(self.x), device=self.x.device)
        self.previous = (self.x, gradient)
        self.x = torch.where(better[:, None], tried[worlds, chosen], self.x)
        factor = torch.where(chosen == 0, 2.0, torch.where(chosen <= 2, 1.0, 0.6))
        factor = torch.where(chosen >= len(LENGTHS), 0.9, factor)
        self.step = (self.step * torch.where(better, factor, 0.3)).clamp(MIN_STEP, MAX_STEP)

    def _add_pair(self, gradient: torch.Tensor) -> None:
        """Store the last step and the change of the gradient over it, from which L-BFGS estimates curvature.

        Starts with curvature below 0 in this step get the factor 0, which leaves the pair out.
        """
        if self.previous is None:
            return
        moved = self.x - self.previous[0]
        change = gradient - self.previous[1]
        product = (moved * change).sum(1)
        convex = product > 1.0e-9 * moved.norm(dim=1) * change.norm(dim=1)
        self.pairs = [*self.pairs[1 - MEMORY :], (moved, change, torch.where(convex, 1.0 / product, 0.0))]

    def _direction(self, gradient: torch.Tensor) -> torch.Tensor:
        """Return descent directions (starts, n) by the two loops of L-BFGS, zero where they would leave the box.

        The loops multiply the gradient by an approximate inverse Hessian, made of past steps and the gradient's changes
        (`pairs`); a start without such a pair, or whose direction would ascend, follows the gradient.
        """
        out = ((self.x <= -1.0) & (gradient > 0.0)) | ((self.x >= 1.0) & (gradient < 0.0))
        free = torch.where(out, 0.0, gradient)
        # names as in the book's algorithm 7.4
        d = free
        alphas = []
        for moved, change, inverse in reversed(self.pairs):
            alpha = inverse * (moved * d).sum(1)
            d = d - alpha[:, None] * change
            alphas.append(alpha)
        scale = torch.ones_like(self.step)
        for moved, change, inverse in self.pairs:
            scale = torch.where(inverse > 0.0, (moved * change).sum(1) / change.square().sum(1).clamp_min(1e-30), scale)
        d = scale[:, None] * d
        for (moved, change, inverse), alpha in zip(self.pairs, reversed(alphas), strict=True):
            d = d + (alpha - inverse * (change * d).sum(1))[:, None] * moved
        d = torch.where(out, 0.0, -d)
        uphill = (d * free).sum(1) >= 0.0
        d = torch.where(uphill[:, None], -free, d)
        # without curvature the largest entry of a step is `step`
        plain = uphill | (torch.stack([pair[2] for pair in self.pairs]).sum(0) == 0.0 if self.pairs else uphill | True)
        largest = d.abs().amax(1).clamp_min(1.0e-12)
        return torch.where(plain[:, None], d * (self.step / largest)[:, None], d)

    def _update_multipliers(self, values: Values) -> None:
        """Update the Lagrange multipliers; multiply penalties by `GROWTH` where the largest violation did not halve."""
        assert self.multipliers is not None
        worst = values.constraints.clamp_min(0.0).amax(1) if values.constraints.shape[1] else self.violation * 0.0
        self.multipliers = (self.multipliers + self.penalty[:, None] * values.constraints).clamp_min(0.0)
        slow = (worst > 0.5 * self.violation) & (worst > FEASIBLE)
        self.penalty = torch.where(slow, GROWTH * self.penalty, self.penalty).clamp_max(MAX_PENALTY)
        self.violation = worst

    def _keep_best(self, x: torch.Tensor, values: Values, count: int) -> None:
        """Update the best point of each start so far from `count` candidates by start, x (starts * count, n)."""
        objective = values.objective.cpu().numpy().reshape(-1, count)
        constraints = values.constraints.cpu().numpy()
        worst = (constraints.max(axis=1, initial=0.0)).reshape(-1, count)
        candidates = x.detach().cpu().numpy().reshape(len(objective), count, -1)
        diverged = ~np.isfinite(objective)
        feasible = np.where(diverged | (worst > FEASIBLE), np.inf, objective)
        here = feasible.argmin(1)
        progress = self.progress
        starts = np.arange(len(objective))
        least = np.where(diverged, np.inf, worst).argmin(1)
        for start in starts:
            if feasible[start, here[start]] < progress.objective[start]:
                progress.objective[start] = feasible[start, here[start]]
                progress.violation[start] = worst[start, here[start]]
                progress.x[start] = candidates[start, here[start]]
            elif not np.isfinite(progress.objective[start]):
                i = least[start]
                if not diverged[start, i] and worst[start, i] < progress.violation[start]:
                    progress.violation[start], progress.x[start] = worst[start, i], candidates[start, i]
