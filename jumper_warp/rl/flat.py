"""Adam optimiser on flat vectors: parameters, gradients and moments of actor and critic are one vector each.

One vector takes one kernel and one all-reduce, where a tensor per parameter takes dozens. Tensors of shape () live on
the device, so that no step waits for the host.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch.optim.adam import adam

from jumper_warp.rl.cfg import PpoCfg
from jumper_warp.rl.networks import ActorCritic

ALIGNMENT = 32  # Every parameter begins at a multiple of this many entries: 128 bytes, a GPU's cache line


def aligned(count: int, to: int) -> int:
    """Round `count` up to a multiple of `to`."""
    return -(-count // to) * to


class Segment(NamedTuple):
    """Location and shape of one parameter tensor in the flat vector of all parameters."""

    start: int  # index of its first entry
    shape: torch.Size

    def view(self, vector: torch.Tensor) -> torch.Tensor:
        """Return a view of this parameter's entries in a flat vector, with the shape `shape`."""
        return vector[self.start : self.start + self.shape.numel()].view(self.shape)


class FlatParameters:
    """All parameters of an `ActorCritic` in one flat vector, `value`, and their gradients in another, `gradient`.

    The model's parameters and their `grad` are views of them.
    Order: actor, noise (log_std), critic. The padding between parameters is zero and stays zero.
    """

    def __init__(self, model: ActorCritic) -> None:
        """Move the parameters of a model into one vector on its device."""
        actor = [*model.actor.parameters(), model.log_std]
        self.params = [*actor, *model.critic.parameters()]
        self.segments: list[Segment] = []
        self.size = 0
        """Number of entries of the whole vector."""
        for param in self.params:
            self.segments.append(Segment(self.size, param.shape))
            self.size += aligned(param.numel(), ALIGNMENT)
        self.actor_size = self.segments[len(actor)].start
        """Number of entries of its first part, actor and noise."""
        device = model.log_std.device
        self.value = torch.zeros(self.size, device=device)
        self.all_reduced = torch.zeros(self.size + ALIGNMENT, device=device)
        """Gradient with `kl` as the last entry, (size + ALIGNMENT,), averaged over ranks in one all-reduce."""
        self.gradient = self.all_reduced[: self.size]
        """Gradient (size,) in the order of `value`."""
        self.kl = self.all_reduced[-1]
        """KL(old ‖ new) () of the minibatch."""
        for param, segment in zip(self.params, self.segments, strict=True):
            view = segment.view(self.value)
            view.copy_(param.data)
            param.data = view
            param.grad = segment.view(self.gradient)


class FlatAdam:
    """Adam optimiser (`torch.optim.Adam`) of a flat vector of parameters."""

    def __init__(self, flat: FlatParameters, lr: float) -> None:
        """Allocate Adam's state, all zeros; lr: initial learning rate, stored on the device as `self.lr`."""
        self.flat = flat
        device = flat.value.device
        self.lr = torch.tensor(lr, device=device)
        self.step_count = torch.zeros((), device=device)
        self.exp_avg = torch.zeros_like(flat.value)
        self.exp_avg_sq = torch.zeros_like(flat.value)

    @property
    def tensors(self) -> tuple[torch.Tensor, ...]:
        """Parameters, moments, number of steps and learning rate, which a step changes."""
        return self.flat.value, self.exp_avg, self.exp_avg_sq, self.step_count, self.lr

    def step(self) -> None:
        """Update parameters and moments in place by one step with `FlatParameters.gradient`."""
        # an object of `torch.optim.Adam` would import torch's compiler, which takes a second
        adam(
            [self.flat.value], [self.flat.gradient], [self.exp_avg], [self.exp_avg_sq], [], [self.step_count],
            fused=True, amsgrad=False, beta1=0.9, beta2=0.999, lr=self.lr, weight_decay=0.0, eps=1.0e-8, maximize=False,
        )  # fmt: skip

    def state_dict(self) -> dict[int, dict[str, torch.Tensor]]:
        """Return copies of Adam's state of each parameter by its index, in the format of `torch.optim.Adam`."""
        vectors = {"exp_avg": self.exp_avg, "exp_avg_sq": self.exp_avg_sq}
        return {
            index: {"step": self.step_count.clone()} | {name: segment.view(v).clone() for name, v in vectors.items()}
            for index, segment in enumerate(self.flat.segments)
        }

    def load_state_dict(self, state: dict[int, dict[str, torch.Tensor]]) -> None:
        """Restore Adam's state from the result of `state_dict`; parameter 0's step count applies to all."""
        for index, segment in enumerate(self.flat.segments):
            segment.view(self.exp_avg).copy_(state[index]["exp_avg"])
            segment.view(self.exp_avg_sq).copy_(state[index]["exp_avg_sq"])
        self.step_count.copy_(state[0]["step"])


def adapted_lr(lr: torch.Tensor, kl: torch.Tensor, cfg: PpoCfg, desired_kl: torch.Tensor | float) -> torch.Tensor:
    """Return the learning rate (), lowered if the KL divergence of the policy update is too large, raised if too small.

    It is divided by 1.5 if kl > 2 desired_kl, and multiplied by 1.5 if kl < desired_kl / 2. A kl below
    1e-6 desired_kl is a rounding error of an unchanged policy and changes nothing. The rate stays within
    cfg.min_lr and cfg.max_lr, and is fixed if cfg.desired_kl is 0. desired_kl: the present target, which moves from
    cfg.desired_kl to cfg.final_desired_kl. PPO assumes small updates; a rate that holds the KL
    divergence near desired_kl makes them as large as that allows.
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
