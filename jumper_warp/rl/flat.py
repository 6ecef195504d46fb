"""Adam optimiser on flat vectors: parameters, gradients and moments of actor and critic are one vector each."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import torch

from jumper_warp.rl.cfg import PpoCfg
from jumper_warp.rl.networks import ActorCritic, ActorTensors, Layers

ALIGNMENT = 32  # Every parameter begins at a multiple of this many entries: 128 bytes, a GPU's cache line
ROW_ALIGNMENT = 8  # Columns of an input layer's weight, and of its features, are zero-padded to a multiple of this
BETAS = (0.9, 0.999)  # Decay rates of Adam's first and second moment per step (Kingma & Ba 2015)
ADAM_EPS = 1.0e-8  # Added to the square root of Adam's second moment


def aligned(count: int, to: int) -> int:
    """Round `count` up to a multiple of `to`."""
    return -(-count // to) * to


class Segment(NamedTuple):
    """Location and shape of one parameter tensor in the flat vector of all parameters."""

    start: int  # index of its first entry
    padded_shape: tuple[int, ...]  # shape with zero-padded columns
    shape: tuple[int, ...]  # shape of the parameter itself

    @property
    def size(self) -> int:
        """Number of entries that the parameter occupies in the flat vector, padding included."""
        return aligned(math.prod(self.padded_shape), ALIGNMENT)

    def padded_view(self, vector: torch.Tensor) -> torch.Tensor:
        """Return a view of this parameter's entries in a flat vector, with the shape `padded_shape`."""
        return vector[self.start : self.start + math.prod(self.padded_shape)].view(self.padded_shape)

    def view(self, vector: torch.Tensor) -> torch.Tensor:
        """Return a view of this parameter's entries in a flat vector, without padding, with the shape `shape`."""
        view = self.padded_view(vector)
        return view[:, : self.shape[1]] if len(self.shape) == 2 else view


class FlatParameters:
    """All parameters of an `ActorCritic` in one flat vector, `value`, and their gradients in another, `gradient`.

    The model's parameters are views of them.
    Order: actor, noise (log_std), critic. The padding between parameters is zero and stays zero.
    """

    def __init__(self, model: ActorCritic, activation: str) -> None:
        """Move the parameters of a model into one vector on its device; activation: that of the hidden layers."""
        actor = [*model.actor.parameters(), model.log_std]
        self.params = [*actor, *model.critic.parameters()]
        input_weights = (model.actor[0].weight, model.critic[0].weight)
        self.segments: list[Segment] = []
        start = 0
        for param in self.params:
            shape = tuple(param.shape)
            pad = any(param is weight for weight in input_weights)
            padded_shape = (shape[0], aligned(shape[1], ROW_ALIGNMENT)) if pad else shape
            self.segments.append(Segment(start, padded_shape, shape))
            start += self.segments[-1].size
        self.size, self.actor_size = start, self.segments[len(actor)].start
        """Number of entries of the whole vector, and of its first part, actor and noise."""
        device = model.log_std.device
        self.value = torch.zeros(self.size, device=device)
        self.all_reduced = torch.zeros(self.size + ALIGNMENT, device=device)
        """Gradient with `kl` as the last entry, (size + ALIGNMENT,), averaged over ranks in one all-reduce."""
        self.gradient, self.kl = self.all_reduced[: self.size], self.all_reduced[-1]
        """Gradient (size,) in the order of `value`, and KL(old ‖ new) () of the minibatch."""
        self.actor_gradient, self.critic_gradient = self.gradient.split((self.actor_size, self.size - self.actor_size))
        for param, segment in zip(self.params, self.segments, strict=True):
            view = segment.view(self.value)
            view.copy_(param.data)
            param.data, param.grad = view, segment.view(self.gradient)
        views = [segment.padded_view(self.value) for segment in self.segments]
        *network, log_std = views[: len(actor)]
        layers, symmetry = _layers(network, activation), model.symmetry
        self.actor = ActorTensors(layers, log_std, symmetry and symmetry.padded(layers.weights[0].shape[1]))
        self.critic = _layers(views[len(actor) :], activation)


def flatten_aligned(gradients: list[torch.Tensor]) -> torch.Tensor:
    """Concatenate gradients of consecutive parameters to one vector, each zero-padded to a multiple of ALIGNMENT."""
    pieces = []
    for gradient in gradients:
        pieces.append(gradient.flatten())
        if padding := aligned(gradient.numel(), ALIGNMENT) - gradient.numel():
            pieces.append(gradient.new_zeros(padding))
    return torch.cat(pieces)


def _layers(params: list[torch.Tensor], activation: str) -> Layers:
    """Group a network's parameters, in the order weight (out, in), bias (out,) of each layer, into `Layers`."""
    return Layers(tuple(params[::2]), tuple(params[1::2]), activation)


class AdamVectors(NamedTuple):
    """Tensors of the Adam optimiser (parameters, gradient, state), in the order of `FlatParameters.value`."""

    value: torch.Tensor  # (size,) parameters
    gradient: torch.Tensor  # (size,) of the loss
    exp_avg: torch.Tensor  # (size,) first moment: running mean of the gradient
    exp_avg_sq: torch.Tensor  # (size,) second moment: running mean of the squared gradient
    step: torch.Tensor  # () number of steps so far
    lr: torch.Tensor  # () learning rate


class FlatAdam:
    """Adam optimiser of a flat vector of parameters; agrees with `torch.optim.Adam` to rounding."""

    def __init__(self, flat: FlatParameters, lr: float) -> None:
        """Allocate Adam's state, all zeros; lr: initial learning rate, stored on the device as `self.lr`."""
        self.flat = flat
        self.exp_avg, self.exp_avg_sq = torch.zeros_like(flat.value), torch.zeros_like(flat.value)
        self.step, self.lr = (torch.full((), x, device=flat.value.device) for x in (0.0, lr))
        self.vectors = AdamVectors(flat.value, flat.gradient, self.exp_avg, self.exp_avg_sq, self.step, self.lr)

    def state_dict(self) -> dict[int, dict[str, torch.Tensor]]:
        """Return copies of Adam's state of each parameter by its index, in the format of `torch.optim.Adam`."""
        return {
            index: {
                "step": self.step.clone(),
                "exp_avg": segment.view(self.exp_avg).clone(memory_format=torch.contiguous_format),
                "exp_avg_sq": segment.view(self.exp_avg_sq).clone(memory_format=torch.contiguous_format),
            }
            for index, segment in enumerate(self.flat.segments)
        }

    def load_state_dict(self, state: dict[int, dict[str, Any]]) -> None:
        """Restore Adam's state from the result of `state_dict`; parameter 0's step count applies to all."""
        for index, segment in enumerate(self.flat.segments):
            segment.view(self.exp_avg).copy_(state[index]["exp_avg"])
            segment.view(self.exp_avg_sq).copy_(state[index]["exp_avg_sq"])
        self.step.copy_(state[0]["step"])


def adapted_lr(lr: torch.Tensor, kl: torch.Tensor, cfg: PpoCfg, desired_kl: torch.Tensor | float) -> torch.Tensor:
    """Return the learning rate (), lowered if the KL divergence of the policy update is too large, raised if too small.

    It is divided by 1.5 if kl > 2 desired_kl, and multiplied by 1.5 if kl < desired_kl / 2. A smaller kl
    than 1e-6 desired_kl is a rounding error of an unchanged policy and changes nothing. The rate stays within
    cfg.min_lr and cfg.max_lr, and is fixed if cfg.desired_kl is 0.
    """
    if cfg.desired_kl <= 0.0:
        return lr
    reduced = torch.where(kl > 2.0 * desired_kl, (lr / 1.5).clamp(min=cfg.min_lr), lr)
    below_half = (kl < 0.5 * desired_kl) & (kl > 1.0e-6 * desired_kl)
    return torch.where(below_half, (lr * 1.5).clamp(max=cfg.max_lr), reduced)


def clip_gradient(gradient: torch.Tensor, actor_size: int, max_norm: float) -> torch.Tensor:
    """Clip the gradients of actor and critic to `max_norm` each, in place; return their norms before clipping, (2,).

    gradient: (size,), the actor's part first. A non-finite part becomes zero.
    """
    parts = (gradient[:actor_size], gradient[actor_size:])
    norms = torch.stack([torch.linalg.vector_norm(part) for part in parts])
    scales = (max_norm / (norms + 1.0e-6)).clamp(max=1.0)
    for part, scale in zip(parts, scales, strict=True):
        part.mul_(scale)
    gradient.nan_to_num_(nan=0.0, posinf=0.0, neginf=0.0)
    return norms


def adam_step(vectors: AdamVectors) -> None:
    """Update parameters and Adam's moments in place by one step of Adam (Kingma & Ba 2015, algorithm 1)."""
    value, gradient, exp_avg, exp_avg_sq, step, lr = vectors
    step.add_(1.0)
    exp_avg.lerp_(gradient, 1.0 - BETAS[0])
    exp_avg_sq.mul_(BETAS[1]).addcmul_(gradient, gradient, value=1.0 - BETAS[1])
    corrections = [-torch.expm1(step * math.log(beta)) for beta in BETAS]  # 1 - beta^step, without cancellation
    root = (exp_avg_sq.sqrt() / corrections[1].sqrt()).add_(ADAM_EPS)
    value.sub_(exp_avg / root * (lr / corrections[0]))
