"""Rollouts: the policy acts in all worlds, and what happened is kept."""

from __future__ import annotations

import torch
from torch.nn import functional

from jumper_warp.envs.vec_env import VecEnv, sanitise
from jumper_warp.rl.cfg import PpoCfg
from jumper_warp.rl.compiling import Compiler
from jumper_warp.rl.flat import FlatParameters, Layers
from jumper_warp.rl.mirror import Symmetry
from jumper_warp.rl.networks import NORMALISED_LIMIT, ActorCritic
from jumper_warp.rl.passes import DTYPES, forward_actor
from jumper_warp.utils.normalise import normalise


class RolloutBuffer:
    """Buffers of num_steps policy steps of all worlds; time is the first axis."""

    def __init__(self, num_steps: int, env: VecEnv, num_critic_obs: int) -> None:
        """num_critic_obs: entries of what the critic sees, which need not be the environment's `critic_obs`."""

        def buffer(*shape: int) -> torch.Tensor:
            return torch.zeros(*shape, device=env.device)

        steps, worlds, actions = num_steps, env.num_envs, env.num_actions
        self.obs = buffer(steps + 1, worlds, env.num_obs)
        self.critic_obs = buffer(steps + 1, worlds, num_critic_obs)
        self.final_critic_obs = buffer(steps, worlds, num_critic_obs)
        self.action = buffer(steps, worlds, actions)
        self.mean = buffer(steps, worlds, actions)
        self.log_std = buffer(actions)
        self.reward = buffer(steps, worlds)
        self.done = buffer(steps, worlds)
        self.timeout = buffer(steps, worlds)


class Collector:
    """Fills a rollout with the present policy."""

    def __init__(self, env: VecEnv, cfg: PpoCfg, model: ActorCritic, flat: FlatParameters, compiler: Compiler) -> None:
        """flat: the parameters of `model`."""
        self.env, self.cfg = env, cfg
        self._critic_obs = env.critic_obs if cfg.asymmetric else env.obs
        self._final_critic_obs = env.final_critic_obs if cfg.asymmetric else env.final_obs
        self.rollout = RolloutBuffer(cfg.num_steps, env, self._critic_obs.shape[1])
        self._moments = model.obs_moments
        self._actor, self._log_std = flat.actor(flat.value)
        self._symmetry = model.symmetry and model.symmetry.padded(self._actor.weights[0].shape[1])
        self._scaling = torch.zeros(2, env.num_obs, device=env.device)
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
        self._scaling.copy_(torch.stack(self._moments.scaling()))
        rollout.log_std.copy_(self._log_std)
        rollout.action.normal_()
        for step in range(self.cfg.num_steps):
            self._decide(step)
            env.step(rollout.action[step])
            self._remember(step)
        rollout.obs[-1] = sanitise(env.obs)
        rollout.critic_obs[-1] = sanitise(self._critic_obs)

    @torch.no_grad()
    def rehearse(self) -> None:
        """Compile, as if one step were made; spoils the rollout and the counts of episodes."""
        self._decide(0)
        self._remember(0)

    def _decide(self, step: int) -> None:
        rollout, dtype = self.rollout, DTYPES[self.cfg.precision]
        seen, kept = (self.env.obs, self._critic_obs), (rollout.obs[step], rollout.critic_obs[step])
        decided = (rollout.mean[step], rollout.action[step])
        self._act(seen, kept, decided, self._actor, self._log_std, self._scaling, dtype, self._symmetry)

    def _remember(self, step: int) -> None:
        env, rollout = self.env, self.rollout
        happened = (env.reward, env.done, env.timeout, self._final_critic_obs)
        kept = (rollout.reward[step], rollout.done[step], rollout.timeout[step], rollout.final_critic_obs[step])
        self._keep(happened, kept, self.episode, self.finished, self.cfg.reward_scale)


Pair = tuple[torch.Tensor, torch.Tensor]


def normalised(obs: torch.Tensor, scaling: torch.Tensor | Pair, columns: int) -> torch.Tensor:
    """Return sanitised observations (batch, n) scaled, limited, and filled up with zeros to so many columns.

    scaling: mean and standard deviation, (n,) each.
    """
    features = normalise(obs, scaling[0], scaling[1], NORMALISED_LIMIT)
    return functional.pad(features, (0, columns - obs.shape[-1]))


def _act(
    seen: Pair, kept: Pair, decided: Pair, actor: Layers, log_std: torch.Tensor, scaling: torch.Tensor,
    dtype: torch.dtype, symmetry: Symmetry | None,
) -> None:  # fmt: skip
    """Keep what actor and critic see, and decide: mean and action, which holds standard normal noise before."""
    for raw, place in zip(seen, kept, strict=True):
        place.copy_(sanitise(raw))
    features = normalised(sanitise(seen[0]), scaling, actor.weights[0].shape[1])
    mean, _, _ = forward_actor(actor, features, symmetry, dtype)
    decided[0].copy_(mean)
    decided[1].mul_(log_std.exp()).add_(mean)


def _keep(
    happened: tuple[torch.Tensor, ...], kept: tuple[torch.Tensor, ...], episode: torch.Tensor, finished: torch.Tensor,
    reward_scale: float,
) -> None:  # fmt: skip
    """Keep reward, done, timeout and the critic's last observation; count returns and lengths."""
    reward = torch.nan_to_num(happened[0], nan=0.0, posinf=0.0, neginf=0.0)
    kept[0].copy_(reward * reward_scale)
    for found, place in zip(happened[1:], kept[1:], strict=True):
        place.copy_(found)
    done = happened[1]
    now = episode + torch.stack([reward, torch.ones_like(reward)])
    finished.add_(torch.cat([now * done, done[None].double()]))
    episode.copy_(now * (1.0 - done))
