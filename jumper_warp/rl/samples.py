"""Conversion of a rollout to training samples with values, advantages (GAE) and returns, one per row of a matrix."""

from __future__ import annotations

from typing import NamedTuple

import torch

from jumper_warp.rl.cfg import PpoCfg
from jumper_warp.rl.networks import ActorCritic, Moments, Scaling, all_reduce_moments


class Batch(NamedTuple):
    """Training samples of PPO: observations, actions, advantages and returns; the first axis is the sample."""

    features: torch.Tensor  # (batch, num_obs) normalised observations
    critic_features: torch.Tensor  # (batch, num_critic_obs) normalised observations of the critic
    action: torch.Tensor  # (batch, num_actions)
    mean: torch.Tensor  # (batch, num_actions) mean of the policy that acted
    log_prob: torch.Tensor  # (batch,) log probability of the action under that policy
    value: torch.Tensor  # (batch,) the critic's output during the rollout
    advantage: torch.Tensor  # (batch,) normalised
    target: torch.Tensor  # (batch,) return, in the units of the critic's output

    def rows(self) -> torch.Tensor:
        """Join the fields to one row per sample, (batch, columns of `RowLayout`)."""
        return torch.cat([*self[:4], torch.stack(self[4:], dim=1)], dim=1)


class RolloutMoments(NamedTuple):
    """Mean, variance and count of the advantages, returns and observations of a rollout."""

    advantage: Moments  # () each
    target: Moments  # () each
    obs: Moments  # (num_obs,)
    critic_obs: Moments  # (num_critic_obs,)


class RowLayout(NamedTuple):
    """Layout of training samples as rows of a matrix, which is written once per iteration and gathered per epoch."""

    num_obs: int
    num_critic_obs: int
    num_actions: int

    @property
    def sizes(self) -> tuple[int, ...]:
        """Numbers of columns of the fields of `Batch`."""
        return self.num_obs, self.num_critic_obs, self.num_actions, self.num_actions, 1, 1, 1, 1

    def split(self, rows: torch.Tensor) -> Batch:
        """Split rows of training samples (batch, columns) into the fields of `Batch`, as views."""
        features, critic_features, action, mean, *scalars = rows.split(self.sizes, dim=1)
        return Batch(features, critic_features, action, mean, *(each[:, 0] for each in scalars))


def gae(
    reward: torch.Tensor, done: torch.Tensor, value: torch.Tensor, gamma: float, lam: float
) -> tuple[torch.Tensor, torch.Tensor]:
    """Compute advantages and returns, each (steps, num_envs), by generalised advantage estimation (GAE).

    Schulman et al. 2016, eq. 16. The recurrence A[t] = δ[t] + w[t] A[t+1] is solved by doubling: log2(steps) passes
    over all steps at once.

    reward: (steps, num_envs), the bootstrap of timeouts included. done: (steps, num_envs), 1 where an episode ended.
    value: (steps + 1, num_envs) expected return before each step and after the last. gamma: discount per step. lam: λ.
    """
    alive = 1.0 - done
    advantage = reward + gamma * alive * value[1:] - value[:-1]
    weight = gamma * lam * alive
    reach = 1  # advantage[t] holds δ[t] .. δ[t + reach - 1], weight[t] is the product of their weights
    while reach < reward.shape[0]:
        longer = torch.addcmul(advantage[:-reach], weight[:-reach], advantage[reach:])
        advantage = torch.cat([longer, advantage[-reach:]])
        weight = torch.cat([weight[:-reach] * weight[reach:], weight[-reach:]])
        reach *= 2
    return advantage, advantage + value[:-1]


def update_statistics(model: ActorCritic, local: RolloutMoments, cfg: PpoCfg) -> Scaling:
    """Update a model's running moments by those of a rollout over all ranks; return the normalisation of advantages.

    Advantages are normalised over the batch of all ranks, with the unbiased variance. A symmetric actor needs a mean
    and a variance of observations that mirror images share. local: moments of this rank's samples.
    """
    moments = RolloutMoments(*all_reduce_moments(local))
    obs_moments = moments.obs
    for each in model.symmetries:
        symmetric = each.obs.symmetrise_moments(obs_moments.mean, obs_moments.var)
        obs_moments = Moments(*symmetric, obs_moments.count)
    model.obs_moments.update_from_moments(obs_moments)
    model.critic_moments.update_from_moments(moments.critic_obs)
    if cfg.normalise_value:
        model.value_moments.update_from_moments(moments.target)
    mean, var, count = moments.advantage
    return Scaling(mean.float(), ((var * count / (count - 1)).sqrt() + 1.0e-8).float())
