"""Proximal policy optimisation (PPO) with PyTorch functions: normalised observations, returns and advantages.

Surrogate: Schulman et al. 2017; advantage: Schulman et al. 2016. The learning rate adapts to the KL divergence.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch

from jumper_warp.envs.vec_env import VecEnv
from jumper_warp.rl.cfg import PpoCfg
from jumper_warp.rl.distributed import all_reduce_mean
from jumper_warp.rl.flat import AdamVectors, adam_step, adapted_lr, clip_gradient, flatten_aligned
from jumper_warp.rl.learner import Learner, StepStatistics
from jumper_warp.rl.networks import ActorTensors, Layers, gaussian_kl, gaussian_log_prob
from jumper_warp.rl.samples import Batch, RowLayout
from jumper_warp.rl.torch.packer import BatchPacker
from jumper_warp.rl.torch.rollout import Collector


class ActorLosses(NamedTuple):
    """PPO's surrogate loss, and entropy, left-right asymmetry and KL divergence of the policy, on a minibatch."""

    surrogate: torch.Tensor  # clipped surrogate loss, lower is better
    entropy: torch.Tensor  # entropy of the policy [nat]
    asymmetry: torch.Tensor  # mean square of f(x) - N f(M x), see `jumper_warp.rl.mirror`; 0 without symmetry
    kl: torch.Tensor  # KL(old ‖ new) [nat]


class Ppo(Learner):
    """PPO learner of PyTorch functions; it trains on every device."""

    def __init__(self, env: VecEnv, cfg: PpoCfg) -> None:
        """Build networks and buffers; arguments and errors as `Learner`."""
        super().__init__(env, cfg)
        self.collector = Collector(env, cfg, self.model, self.flat)
        self.rollout = self.collector.rollout
        obs_mirror = self.symmetry and self.symmetry.obs
        self.packer = BatchPacker(self.rollout, cfg, self.model, self.flat, obs_mirror)
        self._minibatch = self.packer.rows.new_zeros(self.batch_size // cfg.minibatches, self.packer.rows.shape[1])
        self._capture()

    @torch.no_grad()
    def batch(self) -> Batch:
        """See `Learner.batch`; the samples are views of `packer.rows`."""
        self.packer.pack()
        self._sample_orders()
        return self.packer.layout.split(self.packer.rows)

    def optimise(self, samples: torch.Tensor) -> StepStatistics:
        """See `Learner.optimise`; returns the step's losses and gradient norms."""
        torch.index_select(self.packer.rows, 0, samples, out=self._minibatch)
        return self.minibatch_step(self._minibatch)

    @torch.no_grad()
    def minibatch_step(self, rows: torch.Tensor) -> StepStatistics:
        """Run one optimiser step on a minibatch, without host synchronisation; return its losses and gradient norms.

        `statistics` averages them.
        rows: samples (batch, columns of `packer.layout`).
        """
        flat, packer, cfg = self.flat, self.packer, self.cfg
        value_loss = critic_gradient(rows, packer.layout, flat.critic, cfg, flat.critic_gradient)
        losses = actor_gradient(
            rows, packer.layout, flat.actor, packer.old_log_std, self._entropy_coef, cfg, flat.actor_gradient
        )
        flat.kl.copy_(losses.kl)
        all_reduce_mean(flat.all_reduced)  # gradient and divergence
        return optimiser_step(
            self.optimiser.vectors, flat.actor_size, flat.kl, self._desired_kl, cfg, losses, value_loss, self._sums
        )


def critic_gradient(
    rows: torch.Tensor, layout: RowLayout, critic: Layers, cfg: PpoCfg, out: torch.Tensor
) -> torch.Tensor:
    """Compute the gradient of PPO's value loss with respect to the critic's parameters.

    Writes the gradient of the weighted loss to `out`, and returns the value loss () before weighting. The loss is the
    squared error; with `clip_value` the maximum of this and of the squared error of a value clipped to within `clip` of
    the rollout's value.

    rows: (batch, columns of `layout`); out: the critic's slice of the flat gradient.
    """
    batch = layout.split(rows)
    output, layer_inputs = critic.forward(layout.critic_features(rows))
    value_change = output.squeeze(-1) - batch.value
    error = output.squeeze(-1) - batch.target
    loss, grad = error.square(), error
    if cfg.clip_value:
        clipped_error = batch.value + value_change.clamp(-cfg.clip, cfg.clip) - batch.target
        grad = torch.where(clipped_error.square() > loss, clipped_error * (value_change.abs() <= cfg.clip), error)
        loss = torch.maximum(loss, clipped_error.square())
    grad_output = grad * (2.0 * cfg.value_coef / rows.shape[0])
    out.copy_(flatten_aligned(critic.backward(layer_inputs, grad_output[:, None])))
    return loss.mean()


def actor_gradient(
    rows: torch.Tensor, layout: RowLayout, actor: ActorTensors, old_log_std: torch.Tensor, entropy_coef: torch.Tensor,
    cfg: PpoCfg, out: torch.Tensor,
) -> ActorLosses:  # fmt: skip
    """Compute the gradient of PPO's surrogate loss and entropy bonus with respect to actor and noise.

    Writes it to `out`, and returns the losses. The clipped surrogate of Schulman et al. 2017, eq. 7, as a loss:
    -E[min(r A, clip(r) A)] with r = π(a) / π_old(a). Where r A is the smaller, ∂/∂log π = -r A / batch, else 0.

    rows: (batch, columns of `layout`); entropy_coef: (); out: the slice of actor and noise of the flat gradient.
    """
    batch, log_std = layout.split(rows), actor.log_std
    mean, difference, layer_inputs = actor.forward(layout.features(rows))
    ratio = torch.exp(gaussian_log_prob(batch.action, mean, log_std) - batch.log_prob)
    objective = batch.advantage * ratio
    clipped = batch.advantage * ratio.clamp(1.0 - cfg.clip, 1.0 + cfg.clip)
    grad_log_prob = torch.where(objective > clipped, 0.0, objective)[:, None] / -rows.shape[0]
    z = (batch.action - mean) * torch.exp(-log_std)
    grad_log_std = (grad_log_prob * (z.square() - 1.0)).sum(0) - entropy_coef
    gradients = actor.backward(layer_inputs, grad_log_prob * z * torch.exp(-log_std))
    out.copy_(flatten_aligned([*gradients, grad_log_std]))
    entropy = (log_std + 0.5 * math.log(2.0 * math.pi * math.e)).sum()
    kl = gaussian_kl(batch.mean, old_log_std, mean, log_std).mean()
    return ActorLosses(-torch.minimum(objective, clipped).mean(), entropy, difference.square().mean(), kl)


def optimiser_step(
    vectors: AdamVectors, actor_size: int, kl: torch.Tensor, desired_kl: torch.Tensor, cfg: PpoCfg, losses: ActorLosses,
    value_loss: torch.Tensor, sums: torch.Tensor,
) -> StepStatistics:  # fmt: skip
    """Run one step of Adam with an adapted learning rate and a clipped gradient; return losses and gradient norms.

    The rate adapts to the KL divergence kl (). A non-finite gradient is replaced by 0. sums: (len(STATISTICS) + 1,)
    running sums of the statistics, and the number of steps; updated in place.
    """
    vectors.lr.copy_(adapted_lr(vectors.lr, kl, cfg, desired_kl))
    norms = clip_gradient(vectors.gradient, actor_size, cfg.max_grad_norm)
    adam_step(vectors)
    skipped = 1.0 - norms.isfinite().all().float()
    surrogate, entropy, asymmetry, _ = losses
    step = StepStatistics(surrogate, value_loss, entropy, asymmetry, kl.clone(), norms[0], norms[1], skipped)
    sums.add_(torch.nan_to_num(torch.stack([*step, torch.ones_like(kl)]), nan=0.0, posinf=0.0, neginf=0.0))
    return step
