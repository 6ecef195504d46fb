"""Rollout collection: run the policy in all worlds, and record the transitions in a buffer.

Each policy step is written to the buffer in two parts: `_act_step` before the environment's step (observation, action),
`_record_step` after it (reward, end). Nothing waits for the host, so that a rollout can be a captured graph.
"""

from __future__ import annotations

from typing import NamedTuple

import torch

from jumper_warp.envs.vec_env import VecEnv
from jumper_warp.rl.cfg import PpoCfg
from jumper_warp.rl.networks import ActorCritic, Scaling


class RolloutBuffer(NamedTuple):
    """Transitions (observations, action, reward, done) of all worlds over num_steps policy steps."""

    obs: torch.Tensor  # (num_steps + 1, num_envs, num_obs)
    critic_obs: torch.Tensor  # (num_steps + 1, num_envs, num_critic_obs); obs without `asymmetric_critic`
    final_critic_obs: torch.Tensor  # (num_steps, num_envs, num_critic_obs) after the step, before a reset
    action: torch.Tensor  # (num_steps, num_envs, num_actions) sampled
    mean: torch.Tensor  # (num_steps, num_envs, num_actions) of the policy
    log_std: torch.Tensor  # (num_actions,) of the policy, the same in all steps
    reward: torch.Tensor  # (num_steps, num_envs) times `PpoCfg.reward_scale`
    done: torch.Tensor  # (num_steps, num_envs) 1 where the episode ended, by termination or timeout
    timeout: torch.Tensor  # (num_steps, num_envs) 1 where the episode was truncated

    def at(self, step: int) -> RolloutBuffer:
        """Return views of the transitions of one policy step, without the time axis."""
        return self._replace(**{name: x[step] for name, x in self._asdict().items() if name != "log_std"})


def make_rollout_buffer(num_steps: int, env: VecEnv, num_critic_obs: int) -> RolloutBuffer:
    """Return a rollout buffer of zeros on the environment's device; num_critic_obs: size of critic observations."""

    def zeros(*shape: int) -> torch.Tensor:
        """Return a tensor of zeros of a shape on the environment's device."""
        return torch.zeros(*shape, device=env.device)

    steps, worlds, actions = num_steps, env.num_envs, env.num_actions
    obs, critic_obs = zeros(steps + 1, worlds, env.num_obs), zeros(steps + 1, worlds, num_critic_obs)
    action, mean, final_critic_obs = (zeros(steps, worlds, size) for size in (actions, actions, num_critic_obs))
    reward, done, timeout = (zeros(steps, worlds) for _ in range(3))
    return RolloutBuffer(obs, critic_obs, final_critic_obs, action, mean, zeros(actions), reward, done, timeout)


class Collector:
    """Collector of rollouts: steps the environment with the current policy, and records transitions in `rollout`."""

    def __init__(self, env: VecEnv, cfg: PpoCfg, model: ActorCritic) -> None:
        """Allocate the memory of a rollout; model: the policy with its observation statistics."""
        self.env, self.cfg = env, cfg
        self._critic_obs = env.critic_obs if cfg.asymmetric_critic else env.obs
        self._final_critic_obs = env.final_critic_obs if cfg.asymmetric_critic else env.final_obs
        self.rollout = make_rollout_buffer(cfg.num_steps, env, self._critic_obs.shape[1])
        self._steps = [self.rollout.at(step) for step in range(cfg.num_steps)]
        self._model = model
        self._scaling = Scaling(*(torch.zeros(env.num_obs, device=env.device) for _ in Scaling._fields))
        counts = {"dtype": torch.float64, "device": env.device}  # float32 counts to 2^24 only
        self.episode = torch.zeros(2, env.num_envs, **counts)
        """Return and length of each world's current episode, (2, num_envs)."""
        self.finished = torch.zeros(3, env.num_envs, **counts)
        """Sum of returns, sum of lengths and number of the finished episodes, (3, num_envs)."""

    @torch.no_grad()
    def roll(self, generator: torch.Generator | None = None) -> None:
        """Run the current policy for `num_steps` policy steps, and record all transitions in the rollout.

        generator: of the exploration noise (default: torch's).
        """
        env, rollout = self.env, self.rollout
        for scaling, value in zip(self._scaling, self._model.obs_moments.scaling(), strict=True):
            scaling.copy_(value)
        rollout.log_std.copy_(self._model.log_std)
        rollout.action.normal_(generator=generator)
        for step in self._steps:
            self._act_step(step)
            env.step(step.action)
            self._record_step(step)
        rollout.obs[-1] = env.obs
        rollout.critic_obs[-1] = self._critic_obs

    def _act_step(self, step: RolloutBuffer) -> None:
        """Sample every world's action; write it, its mean and the observations to `step` (`RolloutBuffer.at`).

        The action of `step` holds standard normal noise on entry.
        """
        step.obs.copy_(self.env.obs)
        step.critic_obs.copy_(self._critic_obs)
        mean = self._model.mean(self._scaling.features(self.env.obs))
        step.mean.copy_(mean)
        step.action.mul_(self._model.log_std.exp()).add_(mean)

    def _record_step(self, step: RolloutBuffer) -> None:
        """Write the results of an environment step to `step`; update returns and lengths of episodes, unscaled."""
        env = self.env
        reward = torch.nan_to_num(env.reward, nan=0.0, posinf=0.0, neginf=0.0)
        step.reward.copy_(reward * self.cfg.reward_scale)
        step.done.copy_(env.done)
        step.timeout.copy_(env.timeout)
        step.final_critic_obs.copy_(self._final_critic_obs)
        running = self.episode + torch.stack([reward, torch.ones_like(reward)])
        self.finished.add_(torch.cat([running * env.done, env.done[None].double()]))
        self.episode.copy_(running * (1.0 - env.done))
