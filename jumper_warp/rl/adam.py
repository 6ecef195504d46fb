"""One optimiser step on the whole vector of parameters: clipping, step size, Adam."""

from __future__ import annotations

from math import log
from typing import Any, NamedTuple

import torch

from jumper_warp.rl.cfg import PpoCfg
from jumper_warp.rl.flat import FlatParameters

BETAS = (0.9, 0.999)
"""Decay of the means of gradient and squared gradient per step, as in Kingma & Ba 2015."""
EPS = 1.0e-8
"""Added to the root of the mean squared gradient."""


def adapted_lr(lr: torch.Tensor, kl: torch.Tensor, cfg: PpoCfg, desired_kl: torch.Tensor | float) -> torch.Tensor:
    """Return the step size after a divergence: 1.5 times smaller above twice the desired one, larger below half."""
    if cfg.desired_kl <= 0.0:
        return lr
    slower = torch.where(kl > 2.0 * desired_kl, (lr / 1.5).clamp(min=cfg.min_lr), lr)
    too_slow = (kl < 0.5 * desired_kl) & (kl > 0.0)
    return torch.where(too_slow, (lr * 1.5).clamp(max=cfg.max_lr), slower)


class AdamVectors(NamedTuple):
    """What a step reads and changes; all vectors have a place for every parameter."""

    value: torch.Tensor
    gradient: torch.Tensor
    """Longer than the others, see `FlatParameters`."""
    mean: torch.Tensor
    """Running mean of the gradient."""
    square: torch.Tensor
    """Running mean of the squared gradient."""
    step: torch.Tensor
    """() steps so far."""
    lr: torch.Tensor
    """() step size."""


class FlatAdam:
    """Adam's state for a vector of parameters; `torch.optim.Adam` to rounding, and its state for each parameter."""

    def __init__(self, flat: FlatParameters, lr: float) -> None:
        """lr: step size at the start, kept on the device as `self.lr`."""
        self.flat = flat
        self.mean, self.square = torch.zeros_like(flat.value), torch.zeros_like(flat.value)
        self.step = torch.zeros((), device=flat.value.device)
        self.lr = torch.full((), lr, device=flat.value.device)
        self.vectors = AdamVectors(flat.value, flat.gradient, self.mean, self.square, self.step, self.lr)

    def state_dict(self) -> dict[int, dict[str, torch.Tensor]]:
        """Return the state of each parameter by its index, as `torch.optim.Adam` has it, copied."""
        return {
            index: {
                "step": self.step.clone(),
                "exp_avg": segment.own(self.mean).clone(memory_format=torch.contiguous_format),
                "exp_avg_sq": segment.own(self.square).clone(memory_format=torch.contiguous_format),
            }
            for index, segment in enumerate(self.flat.segments)
        }

    def load_state_dict(self, state: dict[int, dict[str, Any]]) -> None:
        """Take up what `state_dict` gave; all parameters have made the same steps."""
        for index, segment in enumerate(self.flat.segments):
            segment.own(self.mean).copy_(state[index]["exp_avg"])
            segment.own(self.square).copy_(state[index]["exp_avg_sq"])
        self.step.copy_(state[0]["step"])


def clip_gradient(gradient: torch.Tensor, actor_size: int, size: int, most: float) -> torch.Tensor:
    """Shorten the parts of actor and critic to the norm `most`, in place; return their norms before, (2,).

    A non-finite part becomes zero.
    """
    parts = (gradient[:actor_size], gradient[actor_size:size])
    norms = torch.stack([torch.linalg.vector_norm(part) for part in parts])
    scales = (most / (norms + 1.0e-6)).clamp(max=1.0)
    for part, scale in zip(parts, scales, strict=True):
        part.mul_(scale)
    gradient.nan_to_num_(nan=0.0, posinf=0.0, neginf=0.0)
    return norms


def adam_step(vectors: AdamVectors) -> None:
    """Change parameters and state by a step of Adam (Kingma & Ba 2015, algorithm 1)."""
    value, gradient, mean, square, step, lr = vectors
    gradient = gradient[: value.shape[0]]
    step.add_(1.0)
    mean.lerp_(gradient, 1.0 - BETAS[0])
    square.mul_(BETAS[1]).addcmul_(gradient, gradient, value=1.0 - BETAS[1])
    corrections = [-torch.expm1(step * log(beta)) for beta in BETAS]  # 1 - beta^step, without cancellation
    root = (square.sqrt() / corrections[1].sqrt()).add_(EPS)
    value.sub_(mean / root * (lr / corrections[0]))


def descend(
    vectors: AdamVectors, actor_size: int, desired_kl: torch.Tensor, cfg: PpoCfg
) -> tuple[torch.Tensor, torch.Tensor]:
    """Make a step along the gradient, whose last number is the divergence, see `FlatParameters`.

    Return the divergence (), and the norms (2,) of the actor's and the critic's gradient before clipping.
    """
    kl = vectors.gradient[-1].clone()
    norms = clip_gradient(vectors.gradient, actor_size, vectors.value.shape[0], cfg.max_grad_norm)
    vectors.lr.copy_(adapted_lr(vectors.lr, kl, cfg, desired_kl))
    adam_step(vectors)
    return kl, norms
