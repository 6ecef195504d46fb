"""Rollout collection with the fused kernels, which stores observations as normalised inputs of actor and critic.

Inputs ("features") are normalised once, when they are observed, instead of in each of the update's epochs. A sample is
one world in one policy step. Padding with zeros gives matrices the widths that the kernels need.
"""

from __future__ import annotations

from typing import NamedTuple

import torch

from jumper_warp.envs.vec_env import VecEnv
from jumper_warp.rl.cfg import PpoCfg
from jumper_warp.rl.flat import aligned
from jumper_warp.rl.fused.kernels import rollout as kernels
from jumper_warp.rl.fused.networks import FusedModel, blocks, launch
from jumper_warp.rl.networks import NORMALISED_LIMIT, ActorCritic, Moments, RunningMoments, Scaling

SAMPLE_ALIGNMENT = 8  # Numbers of columns of `FusedRollout.samples` are a multiple of this
ROWS = 64  # Number of samples in a block of the kernels of this module


class FusedRollout(NamedTuple):
    """Transitions of all worlds over num_steps policy steps, with normalised, zero-padded observations (features)."""

    features: torch.Tensor  # (num_steps, num_envs, padded num_obs)
    critic_features: torch.Tensor  # (num_steps + 1, num_envs, padded num_critic_obs)
    final_features: torch.Tensor  # (num_steps, num_envs, padded num_critic_obs) after the step, before a reset
    samples: torch.Tensor  # (num_steps, num_envs, columns) action, mean, and scalars of `Batch`, zero-padded
    action: torch.Tensor  # (num_steps, num_envs, num_actions)
    log_std: torch.Tensor  # (num_actions,) of the policy, the same in all steps
    reward: torch.Tensor  # (num_steps, num_envs) times `PpoCfg.reward_scale`
    done: torch.Tensor  # (num_steps, num_envs) 1 where the episode ended, by termination or timeout
    timeout: torch.Tensor  # (num_steps, num_envs) 1 where the episode was truncated


class ObservationWriter:
    """Writer that normalises observations, stores them as a network's inputs, and measures their mean and variance."""

    def __init__(self, running: RunningMoments, features: torch.Tensor, num_steps: int) -> None:
        """Allocate sums of observations; running: statistics that normalise; features: (…, num_envs, width)."""
        num_obs, (worlds, width) = len(running.mean), features.shape[-2:]
        self._running, self._grid = running, (blocks(worlds, ROWS), blocks(width, 64))
        self._scaling = Scaling(*(x.to(features.device) for x in (torch.zeros(num_obs), torch.ones(num_obs))))
        self._sums = torch.zeros(num_steps + 1, self._grid[0], 2, width, device=features.device)
        self._num_obs, self._samples = num_obs, num_steps * worlds

    def begin(self) -> None:
        """Fix the normalisation for the next rollout: copy the running mean and standard deviation of observations."""
        for scaling, value in zip(self._scaling, self._running.scaling(), strict=True):
            scaling.copy_(value)

    def write(self, obs: torch.Tensor, features: torch.Tensor, step: int = -1) -> None:
        """Normalise raw observations (num_envs, num_obs), and write them to `features` (num_envs, width).

        step: whose moments they count for (default: none).
        """
        launch(kernels.observe, self._grid, num_warps=8)(
            obs, *obs.stride(), *self._scaling, features, self._sums[step], *obs.shape, features.shape[1],
            NORMALISED_LIMIT, ROWS, 64,
        )  # fmt: skip

    def moments(self) -> Moments:
        """Return mean, variance and count of the rollout's observations before normalisation, in float64."""
        sums = self._sums[:-1].sum((0, 1), dtype=torch.float64)[:, : self._num_obs] / self._samples
        return Moments(self._scaling.mean + sums[0], (sums[1] - sums[0].square()).clamp(min=0.0), self._samples)


class FusedCollector:
    """Collector of rollouts that samples actions with the fused kernels; it has the interface of `Collector`."""

    def __init__(self, env: VecEnv, cfg: PpoCfg, model: ActorCritic, fused: FusedModel) -> None:
        """Allocate the memory of a rollout; fused: networks of `model`."""
        self.env, self.cfg, self._fused, self._log_std = env, cfg, fused, model.log_std
        self._critic_obs = env.critic_obs if cfg.asymmetric_critic else env.obs
        self._final_critic_obs = env.final_critic_obs if cfg.asymmetric_critic else env.final_obs
        steps, worlds, device, dtype = cfg.num_steps, env.num_envs, env.device, fused.weights.dtype
        width, critic_width = (layers[0].inputs for layers in (fused.layout.actor, fused.layout.critic))
        columns = aligned(2 * env.num_actions + 4, SAMPLE_ALIGNMENT)
        critic_features = torch.zeros(2 * steps + 1, worlds, critic_width, dtype=dtype, device=device)
        self.critic_inputs = critic_features.view(-1, critic_width)
        """Features of `critic_features`, then `final_features`, (samples, width)."""
        reward, done, timeout = (torch.zeros(steps, worlds, device=device) for _ in range(3))
        self.rollout = FusedRollout(
            torch.zeros(steps, worlds, width, dtype=dtype, device=device), critic_features[: steps + 1],
            critic_features[steps + 1 :], torch.zeros(steps, worlds, columns, device=device),
            torch.zeros(steps, worlds, env.num_actions, device=device), torch.zeros(env.num_actions, device=device),
            reward, done, timeout,
        )  # fmt: skip
        self.obs_writer = ObservationWriter(model.obs_moments, self.rollout.features, steps)
        self.critic_obs_writer = ObservationWriter(model.critic_moments, critic_features, steps)
        counts = {"dtype": torch.float64, "device": device}  # float32 counts to 2^24 only
        self.episode, self.finished = (torch.zeros(n, worlds, **counts) for n in (2, 3))  # as in `Collector`

    @torch.no_grad()
    def roll(self, generator: torch.Generator | None = None) -> None:
        """Run the current policy for `num_steps` policy steps, and record all transitions in the rollout.

        generator: of the exploration noise (default: torch's).
        """
        self.obs_writer.begin()
        self.critic_obs_writer.begin()
        self._fused.copy_weights()
        self.rollout.log_std.copy_(self._log_std)
        self.rollout.action.normal_(generator=generator)
        for step in range(self.cfg.num_steps):
            self.act(step)
            self.env.step(self.rollout.action[step])
            self.record(step)
        self.critic_obs_writer.write(self._critic_obs, self.rollout.critic_features[-1])

    def act(self, step: int) -> None:
        """Sample actions for the current observations, and store both as policy step `step` of the rollout."""
        rollout, fused, worlds = self.rollout, self._fused, self.env.num_envs
        self.obs_writer.write(self.env.obs, rollout.features[step], step)
        self.critic_obs_writer.write(self._critic_obs, rollout.critic_features[step], step)
        output = fused.actor.forward(rollout.features[step], worlds)
        launch(kernels.sample_action, (blocks(worlds, ROWS),))(
            output, fused.mirror, self._log_std, rollout.action[step], rollout.samples[step], worlds,
            self.env.num_actions, rollout.samples.shape[2], fused.images, fused.actor.width, ROWS,
        )  # fmt: skip

    def record(self, step: int) -> None:
        """Write an environment step's reward, done, timeout and final observation to the rollout; count episodes.

        The final observation is the last one of an episode that has ended, which the critic needs at a timeout.
        """
        env, rollout, worlds = self.env, self.rollout, self.env.num_envs
        self.critic_obs_writer.write(self._final_critic_obs, rollout.final_features[step])
        launch(kernels.record_step, (blocks(worlds, ROWS),))(
            env.reward, env.done, env.timeout, rollout.reward[step], rollout.done[step], rollout.timeout[step],
            self.episode, self.finished, worlds, self.cfg.reward_scale, ROWS,
        )  # fmt: skip
