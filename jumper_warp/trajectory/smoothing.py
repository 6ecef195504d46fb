"""Global search by samples, and descent along smoothed gradients, of many starts at once.

Contacts that begin and end make an objective rough at small scales: its exact gradient is large there and of no use.
The descent follows gradients at randomly displaced points, one a step, whose running mean is the gradient of the
objective smoothed by the displacements; these shrink to nothing. Steps are those of Adam (Kingma and Ba 2015,
arXiv:1412.6980), in units of each entry's own scatter: where the objective is rough in an entry, that moves little.
Starts that fall off an edge of the objective can go back, and beginnings and ends of several can make new ones.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from math import inf

import numpy as np
import torch

from jumper_warp.trajectory.problem import Knots, Problem, Values

FIRST, SECOND = 0.9, 0.98
"""Decay of the means of gradients and of their squares."""
LARGEST_GRADIENT = 0.3
"""[1] Norm to which longer gradients are cut."""
LEAST_SCATTER = 1.0e-3
"""[1] Of a gradient's entry."""
BATCH = 256
"""Candidates that are simulated at once."""
SHIFT = 2
"""Knots by which the end of a crossing comes earlier or later, at most."""
EXACT = 3.0
"""[1] Weight of the largest violation where multipliers are used; more than these come to."""
VIOLATION = 0.05
"""[1] Larger violations raise multipliers no faster."""


@dataclass(frozen=True)
class Stage:
    """Part of a smoothed descent."""

    keep: int
    """Starts that go on from the part before, the best ones."""
    iterations: int
    rate: float
    """[1] First step of an entry."""
    noise: float
    """[1] Standard deviation of the first displacements."""
    least: float = 0.0
    """[1] Share of both down to which they fall over the stage; 1: they stay."""
    penalty: float = 20.0
    """[1] Of squared violations of constraints."""
    dual: float = 0.0
    """[1] What multipliers of constraints gain in an iteration per violation; 0: no multipliers."""
    slack: float = inf
    """[1] A start that counts so much less than it did goes back to its best, which the stage ends with too; infinite:
    all end where they are."""
    look: int = 20
    """Iterations between two looks at what undisplaced starts count, where they can go back."""
    calmer: float = 1.0
    """[1] Factor of the later steps and displacements of a start each time that it goes back."""
    crossings: int = 0
    """Candidates of each start that are tried in its place before the stage begins, see `crossed`."""

    def merit(self, values: Values) -> torch.Tensor:
        """Return what undisplaced candidates count, (n,): with multipliers what `exact` returns, else `penalised`."""
        return exact(values) if self.dual else penalised(values, self.penalty)


STAGES = (
    Stage(32, 60, rate=0.05, noise=0.05, least=1.0),
    Stage(12, 200, rate=0.04, noise=0.04),
    Stage(4, 200, rate=0.02, noise=0.02, penalty=50.0),
)
"""For about a hundred knots."""


def penalised(values: Values, penalty: float = 20.0) -> torch.Tensor:
    """Return objectives with squared violations, (n,)."""
    return values.objective + penalty * values.constraints.clamp_min(0.0).square().sum(1)


def exact(values: Values) -> torch.Tensor:
    """Return objectives with the weighted largest violation, (n,): lowest where constraints are satisfied."""
    return values.objective + EXACT * values.constraints.clamp_min(0.0).amax(1)


def counted(problem: Problem, x: torch.Tensor, merit: Callable[[Values], torch.Tensor]) -> torch.Tensor:
    """Return the merit of candidates (n, len(problem.knots)), (n,); what is not a number is infinite."""
    with torch.no_grad():
        merits = torch.cat([merit(problem.evaluate(part)) for part in x.split(BATCH)])
    return torch.nan_to_num(merits, torch.inf)


def ranked(
    problem: Problem, x: torch.Tensor, merit: Callable[[Values], torch.Tensor] = penalised
) -> tuple[torch.Tensor, torch.Tensor]:
    """Return candidates (n, len(problem.knots)) from the best to the worst, and their merit, (n,)."""
    merits = counted(problem, x, merit)
    order = torch.argsort(merits, stable=True)
    return x[order], merits[order]


def lagrangian(values: Values, multipliers: torch.Tensor, penalty: float) -> torch.Tensor:
    """Return the augmented Lagrangian (n,); with multipliers (n, m) of 0 it is what `penalised` returns."""
    pressed = (multipliers + 2.0 * penalty * values.constraints).clamp_min(0.0)
    return values.objective + (pressed.square() - multipliers.square()).sum(1) / (4.0 * penalty)


def crossed(knots: Knots, x: torch.Tensor, each: int, rng: np.random.Generator) -> torch.Tensor:
    """Return candidates (each, n, len(knots)) with the beginnings of x (n, len(knots)) and ends of others of them.

    The end comes up to SHIFT knots earlier or later.
    """
    whole, rows, shape = x.unflatten(1, (len(knots.at), -1)), np.arange(len(knots.at)), (each, len(x), 1)
    first = np.arange(len(x))[None, :, None]
    second = (first + rng.integers(1, max(2, len(x)), shape)) % len(x)
    ends = rows >= rng.integers(1, len(rows), shape)
    shifted = (rows - rng.integers(-SHIFT, SHIFT + 1, shape)).clip(0, len(rows) - 1)
    return whole[np.where(ends, second, first), np.where(ends, shifted, rows)].flatten(2)


def _best_crossed(problem: Problem, x: torch.Tensor, stage: Stage, rng: np.random.Generator) -> torch.Tensor:
    """Return starts, each replaced by its best crossing where that is better, from the best to the worst."""
    tried = torch.cat([x[None], crossed(problem.knots, x, stage.crossings, rng)])
    merits = counted(problem, tried.flatten(0, 1), stage.merit).unflatten(0, tried.shape[:2])
    best, chosen = merits.min(0)
    return tried[chosen, torch.arange(len(x), device=x.device)][best.argsort(stable=True)]


def _first_multipliers(problem: Problem, x: torch.Tensor, stage: Stage) -> torch.Tensor:
    """Return those that press as the penalty alone would, (n, m); without `dual` zeros, (n, 1)."""
    if not stage.dual:
        return x.new_zeros(len(x), 1)
    with torch.no_grad():
        return 2.0 * stage.penalty * problem.evaluate(x).constraints.clamp_min(0.0)


class _Best:
    """What starts counted most, and where."""

    def __init__(self, problem: Problem, x: torch.Tensor, stage: Stage):
        self.problem, self.stage = problem, stage
        self.x, self.merit = x, counted(problem, x, stage.merit)

    def look(self, x: torch.Tensor, slack: float) -> torch.Tensor:
        """Remember the starts that are better than ever; returns which are worse by more than `slack`, (n, 1)."""
        merit = counted(self.problem, x, self.stage.merit)
        better = merit < self.merit
        self.x, self.merit = torch.where(better[:, None], x, self.x), torch.where(better, merit, self.merit)
        return (merit > self.merit + slack)[:, None]


def descend(problem: Problem, x: torch.Tensor, stage: Stage, rng: np.random.Generator) -> torch.Tensor:
    """Return candidates after one stage."""
    mean, square = torch.zeros_like(x), torch.zeros_like(x)
    best = _Best(problem, x, stage) if stage.slack < inf else None
    multipliers, calm = _first_multipliers(problem, x, stage), x.new_ones(len(x), 1)
    for number in range(stage.iterations):
        left = max(stage.least, 1.0 - number / stage.iterations)
        away = torch.as_tensor(rng.normal(size=tuple(x.shape)), dtype=x.dtype, device=x.device)
        at = (x + left * calm * stage.noise * away).clamp(-1.0, 1.0)
        values, gradient = problem.gradient(at, lambda found, y=multipliers: lagrangian(found, y, stage.penalty))
        multipliers = (multipliers + stage.dual * values.constraints.clamp(-VIOLATION, VIOLATION)).clamp_min(0.0)
        gradient *= (LARGEST_GRADIENT / gradient.norm(dim=1, keepdim=True).clamp_min(1.0e-9)).clamp_max(1.0)
        mean = FIRST * mean + (1.0 - FIRST) * gradient
        square = SECOND * square + (1.0 - SECOND) * gradient.square()
        now, scatter = mean / (1.0 - FIRST ** (number + 1)), (square / (1.0 - SECOND ** (number + 1))).sqrt()
        x = (x - left * calm * stage.rate * now / (scatter + LEAST_SCATTER)).clamp(-1.0, 1.0)
        if best is not None and (number + 1) % stage.look == 0:
            lost = best.look(x, stage.slack)
            x, mean = torch.where(lost, best.x, x), torch.where(lost, 0.0, mean)
            calm = torch.where(lost, stage.calmer * calm, calm)
    if best is None:
        return x
    best.look(x, stage.slack)
    return best.x


def smoothed(
    problem: Problem,
    begin: np.ndarray,
    *,
    stages: Sequence[Stage] = STAGES,
    seed: int = 0,
    tell: Callable[[int, torch.Tensor], None] | None = None,
) -> np.ndarray:
    """Return candidates, the best first, after all stages, as many as the last one keeps.

    begin: candidates (n, len(problem.knots)), of which the best go into the first stage; tell: called after each stage
    with its number and what the candidates count.
    """
    real = torch.float64 if problem.double else torch.float32
    x = torch.as_tensor(begin, dtype=real, device=str(problem.rollout(min(len(begin), BATCH)).device))
    rng = np.random.default_rng(seed)
    x, _ = ranked(problem, x)
    for number, stage in enumerate(stages):
        if stage.crossings:
            x = _best_crossed(problem, x, stage, rng)
        x = descend(problem, x[: stage.keep], stage, rng)
        x, merits = ranked(problem, x, stage.merit)
        if tell is not None:
            tell(number, merits)
    return x.cpu().numpy()
