"""Rollouts: the policy acts in all worlds, and what happened is kept."""

from __future__ import annotations

from typing import NamedTuple

import torch

from jumper_warp.envs.vec_env import VecEnv, sanitise
from jumper_warp.rl.cfg import PpoCfg
from jumper_warp.rl.flat import FlatParameters
from jumper_warp.rl.graphs import Compiler
from jumper_warp.rl.networks import DTYPES, Actor, ActorCritic, Scaling


class RolloutBuffer(NamedTuple):
    """Buffers of policy steps of all worlds; each shape without its first axis in one step's view."""

    obs: torch.Tensor
    """(num_steps + 1, num_envs, num_obs) sanitised."""
    critic_obs: torch.Tensor
    """(num_steps + 1, num_envs, num_critic_obs) sanitised; the actor's without `PpoCfg.asymmetric`."""
    final_critic_obs: torch.Tensor
    """(num_steps, num_envs, num_critic_obs) after the step, before a reset."""
    action: torch.Tensor
    mean: torch.Tensor
    """(num_steps, num_envs, num_actions) of the policy, like the action."""
    log_std: torch.Tensor
    """(num_actions,) of the policy, the same in all steps."""
    reward: torch.Tensor
    """(num_steps, num_envs) times `PpoCfg.reward_scale`."""
    done: torch.Tensor
    timeout: torch.Tensor
    """(num_steps, num_envs) 1 where the episode was cut off; done: where it ended, cut off or not."""

    def at(self, step: int) -> RolloutBuffer:
        """Return views of one step."""
        return self._replace(**{name: x[step] for name, x in self._asdict().items() if name != "log_std"})


def make_rollout_buffer(num_steps: int, env: VecEnv, num_critic_obs: int) -> RolloutBuffer:
    """Return buffers of zeros; num_critic_obs: entries of the critic's observation, which may be the actor's."""

    def buffer(*shape: int) -> torch.Tensor:
        return torch.zeros(*shape, device=env.device)

    steps, worlds, actions = num_steps, env.num_envs, env.num_actions
    obs, critic_obs = buffer(steps + 1, worlds, env.num_obs), buffer(steps + 1, worlds, num_critic_obs)
    action, mean, final_critic_obs = (buffer(steps, worlds, size) for size in (actions, actions, num_critic_obs))
    reward, done, timeout = (buffer(steps, worlds) for _ in range(3))
    return RolloutBuffer(obs, critic_obs, final_critic_obs, action, mean, buffer(actions), reward, done, timeout)


class Collector:
    """Fills a rollout with the present policy."""

    def __init__(self, env: VecEnv, cfg: PpoCfg, model: ActorCritic, flat: FlatParameters, compiler: Compiler) -> None:
        """flat: the parameters of `model`."""
        self.env, self.cfg = env, cfg
        self._critic_obs = env.critic_obs if cfg.asymmetric else env.obs
        self._final_critic_obs = env.final_critic_obs if cfg.asymmetric else env.final_obs
        self.rollout = make_rollout_buffer(cfg.num_steps, env, self._critic_obs.shape[1])
        self._steps = [self.rollout.at(step) for step in range(cfg.num_steps)]
        self._moments, self._actor = model.obs_moments, flat.actor
        self._scaling = Scaling(*(torch.zeros(env.num_obs, device=env.device) for _ in Scaling._fields))
        counts = {"dtype": torch.float64, "device": env.device}  # float32 counts to 2^24 only
        self.episode = torch.zeros(2, env.num_envs, **counts)
        """Return and length so far."""
        self.finished = torch.zeros(3, env.num_envs, **counts)
        """Sums of return and length of the episodes that ended, and their number."""
        self._act, self._keep = compiler(_act), compiler(_keep)

    @torch.no_grad()
    def roll(self) -> None:
        """Act for `num_steps` policy steps."""
        env, rollout = self.env, self.rollout
        for place, value in zip(self._scaling, self._moments.scaling(), strict=True):
            place.copy_(value)
        rollout.log_std.copy_(self._actor.log_std)
        rollout.action.normal_()
        for step in self._steps:
            self._decide(step)
            env.step(step.action)
            self._remember(step)
        rollout.obs[-1] = sanitise(env.obs)
        rollout.critic_obs[-1] = sanitise(self._critic_obs)

    @torch.no_grad()
    def warm_up(self) -> None:
        """Compile, as if one step were made; spoils the rollout and the counts of episodes."""
        self._decide(self._steps[0])
        self._remember(self._steps[0])

    def _decide(self, step: RolloutBuffer) -> None:
        self._act(self.env.obs, self._critic_obs, step, self._actor, self._scaling, DTYPES[self.cfg.precision])

    def _remember(self, step: RolloutBuffer) -> None:
        env, scale = self.env, self.cfg.reward_scale
        self._keep(env.reward, env.done, env.timeout, self._final_critic_obs, step, self.episode, self.finished, scale)


def _act(
    obs: torch.Tensor, critic_obs: torch.Tensor, step: RolloutBuffer, actor: Actor, scaling: Scaling, dtype: torch.dtype
) -> None:
    """Keep raw observations (num_envs, n), and decide: mean and action, which holds standard normal noise before."""
    step.obs.copy_(sanitise(obs))
    step.critic_obs.copy_(sanitise(critic_obs))
    mean = actor.forward(scaling.features(sanitise(obs), actor.layers.weights[0].shape[1]), dtype).mean
    step.mean.copy_(mean)
    step.action.mul_(actor.log_std.exp()).add_(mean)


def _keep(
    reward: torch.Tensor, done: torch.Tensor, timeout: torch.Tensor, final_critic_obs: torch.Tensor,
    step: RolloutBuffer, episode: torch.Tensor, finished: torch.Tensor, reward_scale: float,
) -> None:  # fmt: skip
    """Keep reward, done, timeout and the critic's last observation; count returns and lengths."""
    reward = torch.nan_to_num(reward, nan=0.0, posinf=0.0, neginf=0.0)
    step.reward.copy_(reward * reward_scale)
    step.done.copy_(done)
    step.timeout.copy_(timeout)
    step.final_critic_obs.copy_(final_critic_obs)
    now = episode + torch.stack([reward, torch.ones_like(reward)])
    finished.add_(torch.cat([now * done, done[None].double()]))
    episode.copy_(now * (1.0 - done))
