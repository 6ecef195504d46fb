"""Weights, gradients and Adam's moments of actor and critic, each one vector in memory, and a step of Adam on them."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import torch

from jumper_warp.rl.cfg import PpoCfg
from jumper_warp.rl.networks import Actor, ActorCritic, Layers

ALIGNMENT = 32
"""Every parameter begins at a multiple of so many numbers: 128 bytes, a GPU's cache line."""
ROW_ALIGNMENT = 8
"""Columns of an input layer's weight, and of what it multiplies, are filled up with zeros to a multiple of this."""
BETAS = (0.9, 0.999)
"""Decay of the means of gradient and squared gradient per step, as in Kingma & Ba 2015."""
EPS = 1.0e-8
"""Added to the root of the mean squared gradient."""


def aligned(count: int, to: int) -> int:
    """Return the next multiple of `to` that is not less than `count`."""
    return -(-count // to) * to


class Segment(NamedTuple):
    """Where a parameter lies in the vector."""

    first: int
    stored: tuple[int, ...]
    """Shape, zero columns included."""
    shape: tuple[int, ...]
    """Its own shape."""

    @property
    def size(self) -> int:
        """Numbers up to the next parameter."""
        return aligned(math.prod(self.stored), ALIGNMENT)

    def view(self, vector: torch.Tensor) -> torch.Tensor:
        """Return the parameter's part of a vector, zero columns included."""
        return vector[self.first : self.first + math.prod(self.stored)].view(self.stored)

    def own(self, vector: torch.Tensor) -> torch.Tensor:
        """Return the parameter's part of a vector in its own shape."""
        view = self.view(vector)
        return view[:, : self.shape[1]] if len(self.shape) == 2 else view


class FlatParameters:
    """All parameters of an `ActorCritic` as views of `value`, their gradients as views of `gradient`.

    The order is actor, noise, critic. Between the parameters all numbers are zero, and stay so.
    """

    def __init__(self, model: ActorCritic, activation: str) -> None:
        """Move the parameters of a model, on the device where it is, into one vector."""
        actor = [*model.actor.parameters(), model.log_std]
        self.params = [*actor, *model.critic.parameters()]
        inputs = (model.actor[0].weight, model.critic[0].weight)
        self.segments: list[Segment] = []
        first = 0
        for param in self.params:
            shape = tuple(param.shape)
            wide = any(param is each for each in inputs)
            stored = (shape[0], aligned(shape[1], ROW_ALIGNMENT)) if wide else shape
            self.segments.append(Segment(first, stored, shape))
            first += self.segments[-1].size
        self.size, self.actor_size = first, self.segments[len(actor)].first
        """Numbers of all parameters; of actor and noise, which the critic's follow."""
        device = model.log_std.device
        self.value = torch.zeros(self.size, device=device)
        self.all_reduced = torch.zeros(self.size + ALIGNMENT, device=device)
        """What ranks average in one exchange: the gradient, and `kl` as the last number."""
        self.gradient, self.kl = self.all_reduced[: self.size], self.all_reduced[-1]
        """(size,) as `value`; () KL(old ‖ new) of the minibatch."""
        self.actor_gradient, self.critic_gradient = self.gradient.split((self.actor_size, self.size - self.actor_size))
        for param, segment in zip(self.params, self.segments, strict=True):
            own = segment.own(self.value)
            own.copy_(param.data)
            param.data, param.grad = own, segment.own(self.gradient)
        views = [segment.view(self.value) for segment in self.segments]
        *network, log_std = views[: len(actor)]
        layers, symmetry = _layers(network, activation), model.symmetry
        self.actor = Actor(layers, log_std, symmetry and symmetry.padded(layers.weights[0].shape[1]))
        self.critic = _layers(views[len(actor) :], activation)


def joined(parts: list[torch.Tensor]) -> torch.Tensor:
    """Return the gradients of consecutive parameters, zero columns included, as one part of the vector."""
    pieces = []
    for part in parts:
        pieces.append(part.flatten())
        if gap := aligned(part.numel(), ALIGNMENT) - part.numel():
            pieces.append(part.new_zeros(gap))
    return torch.cat(pieces)


def _layers(params: list[torch.Tensor], activation: str) -> Layers:
    return Layers(tuple(params[::2]), tuple(params[1::2]), activation)


class AdamVectors(NamedTuple):
    """What a step reads and changes; all vectors are (size,) as `FlatParameters.value`."""

    value: torch.Tensor
    gradient: torch.Tensor
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
        self.step, self.lr = (torch.full((), x, device=flat.value.device) for x in (0.0, lr))
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


def adapted_lr(lr: torch.Tensor, kl: torch.Tensor, cfg: PpoCfg, desired_kl: torch.Tensor | float) -> torch.Tensor:
    """Return the step size after a divergence: 1.5 times smaller above twice the desired one, larger below half."""
    if cfg.desired_kl <= 0.0:
        return lr
    slower = torch.where(kl > 2.0 * desired_kl, (lr / 1.5).clamp(min=cfg.min_lr), lr)
    too_slow = (kl < 0.5 * desired_kl) & (kl > 0.0)
    return torch.where(too_slow, (lr * 1.5).clamp(max=cfg.max_lr), slower)


def clip_gradient(gradient: torch.Tensor, actor_size: int, most: float) -> torch.Tensor:
    """Shorten the parts of actor and critic to the norm `most`, in place; return their norms before, (2,).

    A non-finite part becomes zero.
    """
    parts = (gradient[:actor_size], gradient[actor_size:])
    norms = torch.stack([torch.linalg.vector_norm(part) for part in parts])
    scales = (most / (norms + 1.0e-6)).clamp(max=1.0)
    for part, scale in zip(parts, scales, strict=True):
        part.mul_(scale)
    gradient.nan_to_num_(nan=0.0, posinf=0.0, neginf=0.0)
    return norms


def adam_step(vectors: AdamVectors) -> None:
    """Change parameters and state by a step of Adam (Kingma & Ba 2015, algorithm 1)."""
    value, gradient, mean, square, step, lr = vectors
    step.add_(1.0)
    mean.lerp_(gradient, 1.0 - BETAS[0])
    square.mul_(BETAS[1]).addcmul_(gradient, gradient, value=1.0 - BETAS[1])
    corrections = [-torch.expm1(step * math.log(beta)) for beta in BETAS]  # 1 - beta^step, without cancellation
    root = (square.sqrt() / corrections[1].sqrt()).add_(EPS)
    value.sub_(mean / root * (lr / corrections[0]))
