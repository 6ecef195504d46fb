"""Losses of PPO on a minibatch, and their gradients as a part of the gradient vector.

Pure functions of tensors without autograd, so that they compile into few kernels.
"""

from __future__ import annotations

import math

import torch

from jumper_warp.rl.cfg import PpoCfg
from jumper_warp.rl.flat import Layers, joined
from jumper_warp.rl.mirror import Symmetry
from jumper_warp.rl.networks import gaussian_kl, gaussian_log_prob
from jumper_warp.rl.passes import DTYPES, backward, backward_actor, forward, forward_actor
from jumper_warp.rl.samples import RowLayout


def actor_gradient(
    rows: torch.Tensor,
    layout: RowLayout,
    actor: Layers,
    log_std: torch.Tensor,
    old_log_std: torch.Tensor,
    entropy_coef: torch.Tensor,
    cfg: PpoCfg,
    symmetry: Symmetry | None,
    out: torch.Tensor,
) -> tuple[torch.Tensor, ...]:
    """Write the gradient of surrogate and entropy bonus to `out`.

    The clipped surrogate of Schulman et al. 2017, eq. 7, as a loss: -E[min(r A, clip(r) A)] with r = π(a) / π_old(a).
    Where r A is the smaller, ∂/∂log π = -r A / batch, else 0.

    rows: (batch, columns) as `layout`; entropy_coef: (); symmetry: of the policy; out: the vector's part of actor and
    noise. Return surrogate, entropy, mean squared asymmetry (0 without symmetry) and KL(old ‖ new).
    """
    batch, dtype = layout.split(rows), DTYPES[cfg.precision]
    mean, difference, seen = forward_actor(actor, layout.features(rows), symmetry, dtype)
    ratio = torch.exp(gaussian_log_prob(batch.action, mean, log_std) - batch.log_prob)
    gain = batch.advantage * ratio
    clipped = batch.advantage * ratio.clamp(1.0 - cfg.clip, 1.0 + cfg.clip)
    slope = torch.where(gain > clipped, 0.0, gain)[:, None] / -rows.shape[0]
    deviation = (batch.action - mean) * torch.exp(-log_std)
    noise = (slope * (deviation.square() - 1.0)).sum(0) - entropy_coef
    gradients = backward_actor(actor, seen, slope * deviation * torch.exp(-log_std), symmetry, dtype)
    out.copy_(joined([*gradients, noise]))
    entropy = (log_std + 0.5 * math.log(2.0 * math.pi * math.e)).sum()
    kl = gaussian_kl(batch.mean, old_log_std, mean, log_std).mean()
    return -torch.minimum(gain, clipped).mean(), entropy, difference.square().mean(), kl


def critic_gradient(
    rows: torch.Tensor, layout: RowLayout, critic: Layers, cfg: PpoCfg, out: torch.Tensor
) -> torch.Tensor:
    """Write the gradient of the weighted value loss to `out`, and return the loss before weighting.

    The squared error, or with `clip_value` the larger of it and that of the value kept within `clip` of the old one.

    rows: (batch, columns) as `layout`; out: the vector's part of the critic.
    """
    batch, dtype = layout.split(rows), DTYPES[cfg.precision]
    head, seen = forward(critic, layout.critic_features(rows), dtype)
    change = head.squeeze(-1) - batch.value
    error = head.squeeze(-1) - batch.target
    loss, slope = error.square(), error
    if cfg.clip_value:
        near = batch.value + change.clamp(-cfg.clip, cfg.clip) - batch.target
        slope = torch.where(near.square() > loss, near * (change.abs() <= cfg.clip), error)
        loss = torch.maximum(loss, near.square())
    slope = slope * (2.0 * cfg.value_coef / rows.shape[0])
    out.copy_(joined(backward(critic, seen, slope[:, None], dtype)))
    return loss.mean()
