"""Proximal policy optimisation (PPO) with PyTorch functions: normalised observations, returns and advantages.

Surrogate: Schulman et al. 2017; advantage: Schulman et al. 2016. The learning rate adapts to the KL divergence between
the policy that acted ("old") and the present one ("new"). With a left-right symmetric robot, M mirrors an observation,
N an action, and f is the actor's network (`jumper_warp.rl.mirror`).
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch

from jumper_warp.envs.vec_env import VecEnv
from jumper_warp.rl.cfg import PpoCfg
from jumper_warp.rl.distributed import all_reduce_mean
from jumper_warp.rl.flat import FlatAdam, adapted_lr, clip_gradient
from jumper_warp.rl.learner import Learner, StepStatistics
from jumper_warp.rl.networks import ActorCritic, gaussian_kl, gaussian_log_prob
from jumper_warp.rl.samples import Batch
from jumper_warp.rl.torch.packer import BatchPacker
from jumper_warp.rl.torch.rollout import Collector


class Losses(NamedTuple):
    """Losses of PPO, and entropy and KL divergence of the policy, on a minibatch, each ()."""

    surrogate: torch.Tensor  # clipped surrogate loss, lower is better
    value: torch.Tensor  # value loss before weighting [variances of the return]
    entropy: torch.Tensor  # entropy of the policy [nat]
    kl: torch.Tensor  # KL(old ‖ new) [nat]


class Ppo(Learner):
    """PPO learner of PyTorch functions; it trains on every device."""

    def __init__(self, env: VecEnv, cfg: PpoCfg) -> None:
        """Build networks and buffers; arguments and errors as `Learner`."""
        super().__init__(env, cfg)
        self.collector = Collector(env, cfg, self.model)
        self.rollout = self.collector.rollout
        self.packer = BatchPacker(self.rollout, cfg, self.model)
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
        flat.gradient.zero_()
        with torch.enable_grad():
            losses = ppo_losses(self.model, packer.layout.split(rows), packer.old_log_std, cfg)
            (losses.surrogate + cfg.value_coef * losses.value - self._entropy_coef * losses.entropy).backward()
        flat.kl.copy_(losses.kl)
        all_reduce_mean(flat.all_reduced)  # gradient and divergence
        return optimiser_step(self.optimiser, self._desired_kl, cfg, losses, self._sums)


def ppo_losses(model: ActorCritic, batch: Batch, old_log_std: torch.Tensor, cfg: PpoCfg) -> Losses:
    """Return the losses of PPO on a minibatch; only the first three have a gradient.

    Clipping removes the incentive to move the policy further than `clip` in one update.
    The surrogate is that of Schulman et al. 2017, eq. 7, as a loss: -E[min(r A, clip(r) A)] with r = π(a) / π_old(a).
    The value loss is the squared error; with `clip_value` the maximum of this and of the squared error of a value
    clipped to within `clip` of the rollout's value. old_log_std: (num_actions,) of the policy that acted.
    """
    mean = model.mean(batch.features)
    ratio = torch.exp(gaussian_log_prob(batch.action, mean, model.log_std) - batch.log_prob)
    clipped = ratio.clamp(1.0 - cfg.clip, 1.0 + cfg.clip)
    surrogate = -torch.minimum(batch.advantage * ratio, batch.advantage * clipped).mean()
    value = model.value_head(batch.critic_features)
    loss = (value - batch.target).square()
    if cfg.clip_value:
        near = batch.value + (value - batch.value).clamp(-cfg.clip, cfg.clip)
        loss = torch.maximum(loss, (near - batch.target).square())
    entropy = (model.log_std + 0.5 * math.log(2.0 * math.pi * math.e)).sum()
    with torch.no_grad():
        kl = gaussian_kl(batch.mean, old_log_std, mean, model.log_std).mean()
    return Losses(surrogate, loss.mean(), entropy, kl)


def optimiser_step(
    optimiser: FlatAdam, desired_kl: torch.Tensor, cfg: PpoCfg, losses: Losses, sums: torch.Tensor
) -> StepStatistics:
    """Run one step of Adam with an adapted learning rate and a clipped gradient; return losses and gradient norms.

    The rate adapts to `FlatParameters.kl`. A non-finite gradient is replaced by 0. sums: (len(STATISTICS) + 1,) running
    sums of the statistics, and the number of steps; updated in place.
    """
    flat = optimiser.flat
    optimiser.lr.copy_(adapted_lr(optimiser.lr, flat.kl, cfg, desired_kl))
    norms = clip_gradient(flat.gradient, flat.actor_size, cfg.max_grad_norm)
    optimiser.step()
    skipped = 1.0 - norms.isfinite().all().float()
    surrogate = losses.surrogate.detach()
    value = losses.value.detach()
    entropy = losses.entropy.detach()
    step = StepStatistics(surrogate, value, entropy, flat.kl.clone(), norms[0], norms[1], skipped)
    sums.add_(torch.nan_to_num(torch.stack([*step, torch.ones_like(skipped)]), nan=0.0, posinf=0.0, neginf=0.0))
    return step
