"""Global trajectory optimisation by gradient descent at randomly displaced points, from many starts at once.

Contacts that begin and end make an objective rough at small scales, where its exact gradient is large and useless. The
descent follows gradients at randomly displaced points, one per step, whose running mean is the gradient of the
objective smoothed by the displacements; these shrink to 0. Steps are those of Adam (Kingma and Ba 2015,
arXiv:1412.6980): an entry in which gradients scatter moves little. Starts that become worse can return to their best
point, and crossings of starts can replace them.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from math import inf

import numpy as np
import torch

from jumper_warp.trajectory.problem import Knots, Problem, Values

FIRST, SECOND = 0.9, 0.98  # Adam's decay rates of the means of gradients and of squared gradients
LARGEST_GRADIENT = 0.3  # [1] norm to which the gradient of each start is clipped
EPSILON = 1.0e-3  # [1] Adam's epsilon
BATCH = 256  # candidates that one rollout simulates
SHIFT = 2  # largest time shift of the end of a crossing [knots]
EXACT = 3.0  # [1] weight of the largest violation in the exact penalty; larger than the multipliers
MAX_VIOLATION = 0.05  # [1] clip of the violations that raise multipliers


@dataclass(frozen=True)
class Stage:
    """Settings of one stage of the optimisation `smoothed`: starts, steps, random displacements, penalties."""

    keep: int  # Number of best starts that enter the stage
    iterations: int  # Gradient steps of the stage
    rate: float  # [1] Initial learning rate
    noise: float  # [1] Initial standard deviation of the random displacements of actions
    final_fraction: float = 0.0  # [1] Fraction of rate and noise at the end of the stage; they fall linearly
    penalty: float = 20.0  # [1] Weight of squared violations of constraints
    dual: float = 0.0  # [1] Rate at which violations raise the multipliers of constraints; 0: no multipliers
    slack: float = inf
    """[1] A start whose merit exceeds its best by more than this returns to its best point, and the stage returns the
    best points. Infinite: starts never return, and the stage returns the last points."""
    check_every: int = 20  # Iterations between evaluations of the undisplaced starts, after which they can return
    return_scale: float = 1.0  # [1] Factor on a start's later steps and displacements at each return
    crossings: int = 0
    """Number of crossings by start, of which the best replaces the start before the stage, see `crossed`."""

    def merit(self, values: Values) -> torch.Tensor:
        """Return the merit (n,) that ranks candidates, lower is better: `penalised`, or `exact` if `dual` is not 0."""
        return exact(values) if self.dual else penalised(values, self.penalty)


STAGES = (
    Stage(32, 60, rate=0.05, noise=0.05, final_fraction=1.0),
    Stage(12, 200, rate=0.04, noise=0.04),
    Stage(4, 200, rate=0.02, noise=0.02, penalty=50.0),
)
"""Stages for about a hundred knots."""


def penalised(values: Values, penalty: float = 20.0) -> torch.Tensor:
    """Return the quadratic penalty function (n,): the objective plus `penalty` times the sum of squared violations."""
    return values.objective + penalty * values.constraints.clamp_min(0.0).square().sum(1)


def exact(values: Values) -> torch.Tensor:
    """Return the exact penalty function (n,): the objective plus `EXACT` times the largest violation.

    Its minimum satisfies the constraints, since the weight exceeds the multipliers; the quadratic penalty's does not.
    """
    return values.objective + EXACT * values.constraints.clamp_min(0.0).amax(1)


def merit_of(problem: Problem, x: torch.Tensor, merit: Callable[[Values], torch.Tensor]) -> torch.Tensor:
    """Simulate candidates x (n, len(problem.knots)), and return their merit (n,), lower is better, infinite for NaN."""
    with torch.no_grad():
        merits = torch.cat([merit(problem.evaluate(part)) for part in x.split(BATCH)])
    return torch.nan_to_num(merits, torch.inf)


def sort_by_merit(
    problem: Problem, x: torch.Tensor, merit: Callable[[Values], torch.Tensor] = penalised
) -> tuple[torch.Tensor, torch.Tensor]:
    """Return candidates x (n, len(problem.knots)) sorted from lowest to highest merit, and their merit (n,)."""
    merits = merit_of(problem, x, merit)
    order = torch.argsort(merits, stable=True)
    return x[order], merits[order]


def lagrangian(values: Values, multipliers: torch.Tensor, penalty: float) -> torch.Tensor:
    """Return the augmented Lagrangian (n,) of n candidates, which equals `penalised` for multipliers (n, m) of 0.

    With the right multipliers its minimum satisfies the constraints at a moderate penalty.
    """
    pressed = (multipliers + 2.0 * penalty * values.constraints).clamp_min(0.0)
    return values.objective + (pressed.square() - multipliers.square()).sum(1) / (4.0 * penalty)


def crossed(knots: Knots, x: torch.Tensor, count: int, rng: np.random.Generator) -> torch.Tensor:
    """Return new starts, each of which joins the first knots of a start to the last knots of another, random one.

    A good push-off of one start can so meet a good landing of another; gradients alone move every start by itself.
    Returned: `count` crossings of each start x (n, len(knots)), (count, n, len(knots)); the other start's knots are
    shifted in time by up to `SHIFT` knots.
    """
    whole = x.unflatten(1, (len(knots.at), -1))
    rows = np.arange(len(knots.at))
    shape = (count, len(x), 1)
    first = np.arange(len(x))[None, :, None]
    second = (first + rng.integers(1, max(2, len(x)), shape)) % len(x)
    ends = rows >= rng.integers(1, len(rows), shape)
    shifted = (rows - rng.integers(-SHIFT, SHIFT + 1, shape)).clip(0, len(rows) - 1)
    return whole[np.where(ends, second, first), np.where(ends, shifted, rows)].flatten(2)


def _best_crossed(problem: Problem, x: torch.Tensor, stage: Stage, rng: np.random.Generator) -> torch.Tensor:
    """Replace each start x (n, len(knots)) by its best crossing with another start if that is better; sort by merit."""
    tried = torch.cat([x[None], crossed(problem.knots, x, stage.crossings, rng)])
    merits = merit_of(problem, tried.flatten(0, 1), stage.merit).unflatten(0, tried.shape[:2])
    best, chosen = merits.min(0)
    return tried[chosen, torch.arange(len(x), device=x.device)][best.argsort(stable=True)]


def _first_multipliers(problem: Problem, x: torch.Tensor, stage: Stage) -> torch.Tensor:
    """Return initial Lagrange multipliers (n, m) with the penalty's gradient at x; if not `dual`, zeros (n, 1).

    An earlier stage ended where this gradient balances the objective's, so the descent continues without a jump.
    """
    if not stage.dual:
        return x.new_zeros(len(x), 1)
    with torch.no_grad():
        return 2.0 * stage.penalty * problem.evaluate(x).constraints.clamp_min(0.0)


class _BestPoints:
    """Best point x (n, len(knots)) and lowest merit (n,) that the descent from each start has found so far.

    A descent along smoothed gradients can become worse, and then continues from this point.
    """

    def __init__(self, problem: Problem, x: torch.Tensor, stage: Stage):
        """Evaluate the starts x (n, len(knots)), the first best points; stage: whose merit ranks points."""
        self.problem, self.stage = problem, stage
        self.x = x
        self.merit = merit_of(problem, x, stage.merit)

    def update(self, x: torch.Tensor, slack: float) -> torch.Tensor:
        """Store improved points x (n, len(knots)); return whether each is worse than its best by more than `slack`."""
        merit = merit_of(self.problem, x, self.stage.merit)
        better = merit < self.merit
        self.x = torch.where(better[:, None], x, self.x)
        self.merit = torch.where(better, merit, self.merit)
        return (merit > self.merit + slack)[:, None]


def descend(problem: Problem, x: torch.Tensor, stage: Stage, rng: np.random.Generator) -> torch.Tensor:
    """Run one stage of gradient descent from starts x (n, len(knots)), and return a point for each start.

    Gradients are those at randomly displaced points. Returned are the last points or, with finite `slack`, the best.
    """
    mean = torch.zeros_like(x)
    square = torch.zeros_like(x)
    best = _BestPoints(problem, x, stage) if stage.slack < inf else None
    multipliers = _first_multipliers(problem, x, stage)
    scale = x.new_ones(len(x), 1)
    for number in range(stage.iterations):
        decay = max(stage.final_fraction, 1.0 - number / stage.iterations)
        displacement = torch.as_tensor(rng.normal(size=tuple(x.shape)), dtype=x.dtype, device=x.device)
        at = (x + decay * scale * stage.noise * displacement).clamp(-1.0, 1.0)
        values, gradient = problem.gradient(at, lambda values, y=multipliers: lagrangian(values, y, stage.penalty))
        violations = values.constraints.clamp(-MAX_VIOLATION, MAX_VIOLATION)
        multipliers = (multipliers + stage.dual * violations).clamp_min(0.0)
        gradient *= (LARGEST_GRADIENT / gradient.norm(dim=1, keepdim=True).clamp_min(1.0e-9)).clamp_max(1.0)
        mean = FIRST * mean + (1.0 - FIRST) * gradient
        square = SECOND * square + (1.0 - SECOND) * gradient.square()
        step = mean / (1.0 - FIRST ** (number + 1))
        rms = (square / (1.0 - SECOND ** (number + 1))).sqrt()
        x = (x - decay * scale * stage.rate * step / (rms + EPSILON)).clamp(-1.0, 1.0)
        if best is not None and (number + 1) % stage.check_every == 0:
            worse = best.update(x, stage.slack)
            x = torch.where(worse, best.x, x)
            mean = torch.where(worse, 0.0, mean)
            scale = torch.where(worse, stage.return_scale * scale, scale)
    if best is None:
        return x
    best.update(x, stage.slack)
    return best.x


def smoothed(
    problem: Problem,
    begin: np.ndarray,
    *,
    stages: Sequence[Stage] = STAGES,
    seed: int = 0,
    callback: Callable[[int, torch.Tensor], None] | None = None,
) -> np.ndarray:
    """Minimise a trajectory optimisation problem by gradient descent at randomly displaced points, in several stages.

    Returned: candidates, lowest merit first, (keep of the last stage, len(problem.knots)). begin: candidates (n,
    len(problem.knots)), of which the first stage keeps the best. callback: called after each stage with its index and
    the merits (keep,) of its candidates.
    """
    real = torch.float64 if problem.double else torch.float32
    x = torch.as_tensor(begin, dtype=real, device=str(problem.rollout(min(len(begin), BATCH)).device))
    rng = np.random.default_rng(seed)
    x, _ = sort_by_merit(problem, x)
    for number, stage in enumerate(stages):
        if stage.crossings:
            x = _best_crossed(problem, x, stage, rng)
        x = descend(problem, x[: stage.keep], stage, rng)
        x, merits = sort_by_merit(problem, x, stage.merit)
        if callback is not None:
            callback(number, merits)
    return x.cpu().numpy()
