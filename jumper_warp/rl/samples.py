"""Conversion of a rollout to training samples with values, advantages (GAE) and returns, one per row of a matrix."""

from __future__ import annotations

from itertools import accumulate
from typing import NamedTuple

import torch

from jumper_warp.rl.flat import ROW_ALIGNMENT, aligned
from jumper_warp.rl.networks import Moments


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


class RolloutMoments(NamedTuple):
    """Mean, variance and count of the advantages, returns and observations of a rollout."""

    advantage: Moments  # () each
    target: Moments  # () each
    obs: Moments  # (num_obs,)
    critic_obs: Moments  # (num_critic_obs,)


class RowLayout(NamedTuple):
    """Layout of one training sample in a row of a matrix: actor features, critic features, other data of `Batch`.

    Each of the three groups begins at a multiple of ROW_ALIGNMENT. A row is written once per iteration and gathered
    once per epoch.
    """

    num_obs: int  # numbers of entries without padding
    num_critic_obs: int
    num_actions: int

    @property
    def widths(self) -> tuple[int, int, int]:
        """Numbers of columns of actor features, critic features and the rest, each a multiple of ROW_ALIGNMENT."""
        obs, critic_obs = aligned(self.num_obs, ROW_ALIGNMENT), aligned(self.num_critic_obs, ROW_ALIGNMENT)
        return obs, critic_obs, aligned(2 * self.num_actions + 4, ROW_ALIGNMENT)

    def features(self, rows: torch.Tensor) -> torch.Tensor:
        """Return the actor's normalised observations in rows of training samples, zero-padded.

        The result is (batch, columns of the first weight); rows: (batch, columns).
        """
        return rows[:, : self.widths[0]]

    def critic_features(self, rows: torch.Tensor) -> torch.Tensor:
        """Return the critic's normalised observations in rows of training samples, zero-padded.

        The result is (batch, columns of the first weight); rows: (batch, columns).
        """
        return rows[:, self.widths[0] : sum(self.widths[:2])]

    def split(self, rows: torch.Tensor) -> Batch:
        """Split rows of training samples (batch, columns) into the fields of `Batch`, as views without padding."""
        sizes = (self.num_obs, self.widths[0] - self.num_obs, self.num_critic_obs, self.widths[1] - self.num_critic_obs,
                 self.num_actions, self.num_actions, 1, 1, 1, 1)  # fmt: skip
        starts = list(accumulate(sizes, initial=0))
        columns = [rows[:, start : start + size] for start, size in zip(starts, sizes, strict=False)]
        features, _, critic_features, _, action, mean, *scalars = columns
        return Batch(features, critic_features, action, mean, *(each[:, 0] for each in scalars))

    def pack(self, batch: Batch) -> torch.Tensor:
        """Join the fields of training samples to one zero-padded row each, (batch, columns); inverts `split`."""
        scalars = torch.stack([batch.log_prob, batch.value, batch.advantage, batch.target], dim=-1)
        groups = ([batch.features], [batch.critic_features], [batch.action, batch.mean, scalars])
        pieces: list[torch.Tensor] = []
        for group, width in zip(groups, self.widths, strict=True):
            pieces += group
            if padding := width - sum(each.shape[1] for each in group):
                pieces.append(scalars.new_zeros(scalars.shape[0], padding))
        return torch.cat(pieces, dim=1)


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
