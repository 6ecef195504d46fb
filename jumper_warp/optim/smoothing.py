"""Global search by samples, and descent along smoothed gradients, of many starts at once.

Contacts that begin and end make an objective rough at small scales: its exact gradient is large there and of no use.
The descent follows gradients at randomly displaced points, one a step, whose running mean is the gradient of the
objective smoothed by the displacements; these shrink to nothing. Steps are those of Adam (Kingma and Ba 2015,
arXiv:1412.6980), in units of each entry's own scatter: where the objective is rough in an entry, that moves little.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import torch

from jumper_warp.optim.trajectory import Problem, Values

FIRST, SECOND = 0.9, 0.98
"""Decay of the means of gradients and of their squares."""
LARGEST_GRADIENT = 0.3
"""[1] Norm to which longer gradients are cut."""
LEAST_SCATTER = 1.0e-3
"""[1] Of a gradient's entry."""
BATCH = 256
"""Candidates that are simulated at once."""


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
    fall: bool = True
    """Whether both fall to zero over the stage."""
    penalty: float = 20.0
    """[1] Of squared violations of constraints."""


STAGES = (
    Stage(32, 60, rate=0.05, noise=0.05, fall=False),
    Stage(12, 200, rate=0.04, noise=0.04),
    Stage(4, 200, rate=0.02, noise=0.02, penalty=50.0),
)
"""For about a hundred knots."""


def penalised(values: Values, penalty: float) -> torch.Tensor:
    """Return objectives with squared violations, (n,)."""
    return values.objective + penalty * values.constraints.clamp_min(0.0).square().sum(1)


def ranked(problem: Problem, x: torch.Tensor, penalty: float = 20.0) -> tuple[torch.Tensor, torch.Tensor]:
    """Return candidates (n, len(problem.knots)) from the best to the worst, and what they count, (n,)."""
    with torch.no_grad():
        merits = torch.cat([penalised(problem.evaluate(part), penalty) for part in x.split(BATCH)])
    order = torch.argsort(torch.nan_to_num(merits, torch.inf), stable=True)
    return x[order], merits[order]


def descend(problem: Problem, x: torch.Tensor, stage: Stage, rng: np.random.Generator) -> torch.Tensor:
    """Return candidates after one stage."""
    mean, square = torch.zeros_like(x), torch.zeros_like(x)
    for number in range(stage.iterations):
        left = 1.0 - number / stage.iterations if stage.fall else 1.0
        away = torch.as_tensor(rng.normal(size=tuple(x.shape)), dtype=x.dtype, device=x.device)
        at = (x + left * stage.noise * away).clamp(-1.0, 1.0)
        _, gradient = problem.gradient(at, lambda values: penalised(values, stage.penalty))
        gradient *= (LARGEST_GRADIENT / gradient.norm(dim=1, keepdim=True).clamp_min(1.0e-9)).clamp_max(1.0)
        mean = FIRST * mean + (1.0 - FIRST) * gradient
        square = SECOND * square + (1.0 - SECOND) * gradient.square()
        now, scatter = mean / (1.0 - FIRST ** (number + 1)), (square / (1.0 - SECOND ** (number + 1))).sqrt()
        x = (x - left * stage.rate * now / (scatter + LEAST_SCATTER)).clamp(-1.0, 1.0)
    return x


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
        x = descend(problem, x[: stage.keep], stage, rng)
        x, merits = ranked(problem, x, stage.penalty)
        if tell is not None:
            tell(number, merits)
    return x.cpu().numpy()
