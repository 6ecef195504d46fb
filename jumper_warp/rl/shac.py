"""Short-horizon actor-critic: the policy climbs the gradient of short windows of reward through the physics.

A window has H policy steps of all worlds, with the policy's noise reparametrised. The actor's loss is minus the mean
over worlds of sum_t g^t r_t + g^H V(s_H), differentiated through rewards, physics and policy; V is a target critic that
follows the critic slowly. Where an episode ends the sum begins anew, with the value of the last state if it was cut
off. The critic learns TD(lambda) returns of the same window. After Xu et al. 2022, Accelerated policy learning with
parallel differentiable simulation.
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch.nn import functional

from jumper_warp.envs.vec_env import DifferentiableVecEnv, sanitise
from jumper_warp.rl.cfg import PpoCfg, ShacCfg
from jumper_warp.rl.networks import ActorCritic
from jumper_warp.rl.ppo import take_averages
from jumper_warp.utils.errors import InputError
from jumper_warp.utils.state_checks import check_parts, check_tensor

STATISTICS = ("actor", "value", "gradient_actor", "gradient_critic")
"""What `Shac.statistics` averages over optimiser steps."""


class Shac:
    """The algorithm on one environment, with the interface of `Ppo` that a run uses."""

    def __init__(self, env: DifferentiableVecEnv, cfg: PpoCfg, shac: ShacCfg) -> None:
        """Build networks on the environment's device; the weights follow torch's CPU seed.

        Raises InputError: the environment has no gradients.
        """
        if not hasattr(env, "step_with_gradient"):
            raise InputError("trainer shac needs an environment with gradients")
        self.env, self.cfg, self.shac = env, cfg, shac
        self.batch_size = cfg.num_steps * env.num_envs
        critic_obs = env.num_critic_obs if cfg.asymmetric_critic else env.num_obs
        self.model = ActorCritic(
            env.num_obs, env.num_actions, cfg.hidden, cfg.activation, cfg.init_std, critic_obs
        ).to(env.device)  # fmt: skip
        self.target = copy.deepcopy(self.model.critic).requires_grad_(False)
        self._actor = [*self.model.actor.parameters(), self.model.log_std]
        self._critic = list(self.model.critic.parameters())
        self.optimisers = {
            "actor": torch.optim.Adam(self._actor, shac.lr, (0.7, 0.95)),
            "critic": torch.optim.Adam(self._critic, shac.critic_lr, (0.7, 0.95)),
        }
        self.lr = torch.tensor(shac.lr)
        self.episode = torch.zeros(2, env.num_envs, device=env.device, dtype=torch.float64)
        self._finished = torch.zeros(3, device=env.device, dtype=torch.float64)
        self._sums = torch.zeros(len(STATISTICS) + 1, dtype=torch.float64)

    def prepare(self) -> None:
        """Nothing is to be compiled."""

    def close(self) -> None:
        """Nothing is held."""

    def iterate(self, mark: Callable[[], None] = lambda: None) -> None:
        """Do one iteration; mark is called after the actor's and the critic's part."""
        window = self.window()
        loss = window.pop("loss")
        for group in self.optimisers["actor"].param_groups:
            group["lr"] = float(self.lr)
        actor_norm = self._descend("actor", self._actor, loss, self.shac.max_grad_norm)
        mark()
        value_loss, critic_norm = self._learn_values(**window)
        mark()
        self._sums += torch.tensor([float(loss.detach()), value_loss, actor_norm, critic_norm, 1.0]).double()

    def window(self) -> dict[str, torch.Tensor]:
        """Act for a window; return the actor's loss, and what the critic learns from, time first."""
        env, cfg, model = self.env, self.cfg, self.model
        seen: dict[str, list[torch.Tensor]] = {name: [] for name in ("obs", "critic_obs", "reward", "next", "done")}
        discount, total = torch.ones(env.num_envs, device=env.device), torch.zeros(env.num_envs, device=env.device)
        env.begin_window()
        for step in range(cfg.num_steps):
            obs, critic_obs = env.observe()
            mean = model.mean(model.features(obs))
            noise = torch.randn_like(mean)
            action = mean + model.log_std.exp() * noise
            reward = cfg.reward_scale * torch.nan_to_num(env.step_with_gradient(action), 0.0, 0.0, 0.0)
            seen["obs"].append(obs.detach())
            seen["critic_obs"].append((critic_obs if cfg.asymmetric_critic else obs).detach())
            seen["reward"].append(reward.detach())
            done, timeout = env.done.clone(), env.timeout.clone()
            after = self._target_value(env.observe_final()[int(cfg.asymmetric_critic)]) * timeout
            if step == cfg.num_steps - 1:
                following = self._target_value(env.observe()[int(cfg.asymmetric_critic)])
            else:
                following = self._target_value((env.critic_obs if cfg.asymmetric_critic else env.obs).clone()).detach()
            value = torch.where(done > 0.0, after, following)
            seen["next"].append(value.detach())
            seen["done"].append(done)
            total = total + discount * reward
            discount = discount * cfg.gamma
            ends = torch.ones_like(done) if step == cfg.num_steps - 1 else done
            total = total + ends * discount * value
            discount = torch.where(done > 0.0, 1.0, discount)
            self._count(reward.detach() / cfg.reward_scale, done)
        entropy = model.log_std.sum()
        loss = -total.mean() / cfg.num_steps - self.shac.entropy_coef * entropy
        return {"loss": loss, **{name: torch.stack(rows) for name, rows in seen.items()}}

    def _target_value(self, critic_obs: torch.Tensor) -> torch.Tensor:
        head = self.target(self.model.critic_features(critic_obs)).squeeze(-1)
        return self.model.value_moments.scaling().restore(head)

    def _count(self, reward: torch.Tensor, done: torch.Tensor) -> None:
        now = self.episode + torch.stack([reward, torch.ones_like(reward)])
        self._finished += torch.cat([(now * done).sum(1), done.sum()[None].double()])
        self.episode = now * (1.0 - done)

    def _learn_values(
        self, obs: torch.Tensor, critic_obs: torch.Tensor, reward: torch.Tensor, next: torch.Tensor, done: torch.Tensor
    ) -> tuple[float, float]:
        """Fit the critic to TD(lambda) returns, move the target, take in the statistics; return loss and norm."""
        cfg, shac, model = self.cfg, self.shac, self.model
        returns, later = torch.zeros_like(reward), next[-1]
        for step in reversed(range(len(reward))):
            mixed = torch.where(done[step] > 0.0, next[step], (1.0 - cfg.lam) * next[step] + cfg.lam * later)
            later = returns[step] = reward[step] + cfg.gamma * mixed
        model.obs_moments.update(sanitise(obs.flatten(0, 1)))
        model.critic_moments.update(sanitise(critic_obs.flatten(0, 1)))
        if cfg.normalise_value:
            model.value_moments.update(returns.flatten())
        features = model.critic_features(critic_obs.flatten(0, 1))
        wanted = model.value_moments.scaling().normalise(returns.flatten())
        losses, norms = [], []
        for _ in range(shac.critic_epochs):
            for rows in torch.randperm(len(wanted), device=wanted.device).chunk(shac.critic_minibatches):
                loss = functional.mse_loss(model.value_head(features[rows]), wanted[rows])
                norms.append(self._descend("critic", self._critic, loss, cfg.max_grad_norm))
                losses.append(float(loss.detach()))
        with torch.no_grad():
            for slow, fast in zip(self.target.parameters(), self._critic, strict=True):
                slow.lerp_(fast, shac.target_rate)
        return sum(losses) / len(losses), sum(norms) / len(norms)

    def _descend(self, name: str, params: Sequence[torch.Tensor], loss: torch.Tensor, longest: float) -> float:
        """Make an optimiser step, none if the gradient is not finite; return its norm before it is shortened."""
        optimiser = self.optimisers[name]
        optimiser.zero_grad()
        loss.backward(inputs=params)
        length = float(torch.nn.utils.clip_grad_norm_(params, longest))
        if length < float("inf"):
            optimiser.step()
        return length

    def set_progress(self, progress: float) -> None:
        """Tell how much of the training is over, from 0 to 1."""
        self.lr.fill_(self.shac.lr * (1.0 - 0.9 * min(max(progress, 0.0), 1.0)))

    def statistics(self) -> dict[str, float]:
        """Return averages since the last call, of losses and of finished episodes."""
        return take_averages(STATISTICS, self._sums, self._finished, self.lr, self.model.log_std)

    def _parts(self) -> dict[str, torch.Tensor]:
        """Return all tensors of the state by name, in place where there are any."""
        parts = {f"model.{name}": value for name, value in self.model.state_dict().items()}
        parts |= {f"target.{name}": value for name, value in self.target.state_dict().items()}
        for name, optimiser in self.optimisers.items():
            for index, param in enumerate(optimiser.param_groups[0]["params"]):
                moments = optimiser.state[param] or {
                    "step": torch.tensor(0.0), "exp_avg": torch.zeros_like(param), "exp_avg_sq": torch.zeros_like(param)
                }  # fmt: skip
                optimiser.state[param] = moments
                parts |= {f"{name}.{index}.{key}": value for key, value in moments.items()}
        return parts | {"lr": self.lr, "episode": self.episode}

    def state_dict(self) -> dict[str, Any]:
        """Return networks, statistics and optimisers, tensors only."""
        rest = {name: value.detach().clone() for name, value in self._parts().items() if not name.startswith("model.")}
        return {"model": {name: value.clone() for name, value in self.model.state_dict().items()}, **rest}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Take up what `state_dict` gave. Raises ValueError: a part is missing, unknown or of another shape or type."""
        flat = {f"model.{name}": value for name, value in state["model"].items()}
        flat |= {name: value for name, value in state.items() if name != "model"}
        parts = self._parts()
        check_parts(flat, parts, "shac")
        for name, like in parts.items():
            check_tensor(flat[name], like, f"shac.{name}")
        with torch.no_grad():
            for name, place in parts.items():
                place.copy_(flat[name])
