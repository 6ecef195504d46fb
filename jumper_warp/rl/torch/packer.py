"""Conversion of a rollout to training samples with values, advantages and returns, by PyTorch functions.

A sample is one world in one policy step; time-major: all worlds of step 0, then those of step 1. The critic predicts
normalised returns (zero mean, unit variance), so that its scale does not depend on the rewards'.
"""

from __future__ import annotations

from typing import NamedTuple

import torch

from jumper_warp.rl.cfg import PpoCfg
from jumper_warp.rl.networks import ActorCritic, Moments, Scaling, gaussian_log_prob
from jumper_warp.rl.samples import Batch, RolloutMoments, RowLayout, gae, update_statistics
from jumper_warp.rl.torch.rollout import RolloutBuffer

CPU_CHUNK_SIZE = 4096  # Samples per chunk on a CPU, so that intermediate tensors stay in its caches


class Estimates(NamedTuple):
    """Values, advantages and returns of all steps of a rollout; batch = num_steps · num_envs, time-major."""

    value: torch.Tensor  # (batch,) the critic's output [standard deviations of the return]
    advantage: torch.Tensor  # (batch,) in scaled rewards
    target: torch.Tensor  # (batch,) returns in scaled rewards
    moments: RolloutMoments  # moments over this rank's samples


class Scalings(NamedTuple):
    """Means and standard deviations that normalise observations and returns."""

    obs: Scaling  # (num_obs,)
    critic_obs: Scaling  # (num_critic_obs,)
    value: Scaling  # () for the return


class BatchPacker:
    """Converter of a rollout to PPO's training samples, with advantages and returns, one per row of `rows`."""

    def __init__(self, rollout: RolloutBuffer, cfg: PpoCfg, model: ActorCritic) -> None:
        """Allocate memory for the training samples of a rollout."""
        self._rollout, self._cfg, self._model = rollout, cfg, model
        steps, worlds, num_actions = rollout.action.shape
        self.layout = RowLayout(rollout.obs.shape[2], rollout.critic_obs.shape[2], num_actions)
        self.rows = rollout.obs.new_zeros(steps * worlds, sum(self.layout.sizes))
        """Packed samples, (steps · worlds, columns of `layout`), time-major."""
        self.old_log_std = torch.zeros_like(rollout.log_std)  # (num_actions,) of the policy that acted
        self._chunk_size = CPU_CHUNK_SIZE if self.rows.device.type == "cpu" else None

    @torch.no_grad()
    def pack(self) -> None:
        """Compute advantages and returns, write the samples to `rows`, and update the normalisation statistics."""
        model = self._model
        moments = (model.obs_moments, model.critic_moments, model.value_moments)
        scalings = Scalings(*(each.scaling() for each in moments))  # those that actor and critic used in the rollout
        estimates = self._estimates(scalings)
        advantage_scaling = update_statistics(model, estimates.moments, self._cfg)
        self._write_rows(scalings, estimates, advantage_scaling)
        self.old_log_std.copy_(self._rollout.log_std)

    def _estimates(self, scalings: Scalings) -> Estimates:
        """Return values, advantages and returns (num_steps · num_envs,) of the rollout, and moments of its samples.

        A timeout adds the discounted value of the final observation: the episode was cut, and would have earned more.
        """
        buffer, model, cfg = self._rollout, self._model, self._cfg

        def value_head(critic_obs: torch.Tensor) -> torch.Tensor:
            """Return the critic's output (steps, num_envs) for (steps, num_envs, num_critic_obs)."""
            chunks = self._chunks(critic_obs.flatten(0, 1))
            heads = [model.value_head(scalings.critic_obs.features(chunk)) for chunk in chunks]
            return torch.cat(heads).view(critic_obs.shape[:2])

        head, final_head = value_head(buffer.critic_obs), value_head(buffer.final_critic_obs)
        value, final_value = scalings.value.denormalise(head), scalings.value.denormalise(final_head)
        reward = buffer.reward + cfg.gamma * buffer.timeout * final_value
        advantage, target = (x.flatten() for x in gae(reward, buffer.done, value, cfg.gamma, cfg.lam))
        samples = (advantage, target, buffer.obs[:-1].flatten(0, 1), buffer.critic_obs[:-1].flatten(0, 1))
        moments = RolloutMoments(*(Moments.from_samples(x, self._chunk_size) for x in samples))
        return Estimates(head[:-1].flatten(), advantage, target, moments)

    def _write_rows(self, scalings: Scalings, estimates: Estimates, advantage_scaling: Scaling) -> None:
        """Normalise the rollout's training samples, and write them to `rows`, one per row."""
        buffer = self._rollout
        target = estimates.target
        if self._cfg.normalise_value:
            target = self._model.value_moments.scaling().normalise(target)
        steps = [x.flatten(0, 1) for x in (buffer.obs[:-1], buffer.critic_obs[:-1], buffer.action, buffer.mean)]
        pieces = [self.rows, *steps, estimates.value, advantage_scaling.normalise(estimates.advantage), target]
        for out, obs, critic_obs, action, mean, *estimated in zip(*map(self._chunks, pieces), strict=True):
            features = scalings.obs.features(obs)
            critic_features = scalings.critic_obs.features(critic_obs)
            log_prob = gaussian_log_prob(action, mean, buffer.log_std)
            out.copy_(Batch(features, critic_features, action, mean, log_prob, *estimated).rows())

    def _chunks(self, x: torch.Tensor) -> tuple[torch.Tensor, ...]:
        """Split x (batch, ...) into views of rows that fit a CPU's caches, the last with the remainder."""
        return x.split(self._chunk_size or x.shape[0])
