"""Short-horizon actor-critic (SHAC): gradient ascent on the return of short windows, through differentiable physics.

A window has H policy steps of all worlds, with the policy's noise reparametrised. The actor's loss is minus the mean
over worlds of sum_t g^t r_t + g^H V(s_H), differentiated through rewards, physics and policy. V is a target critic,
which follows the critic slowly. Where an episode ends the sum restarts, with the final state's value after a timeout.
The critic is fitted to TD(lambda) returns of the same window. After Xu et al. 2022, Accelerated policy learning with
parallel differentiable simulation.
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import torch
from torch.nn import functional

from jumper_warp.envs.vec_env import DifferentiableVecEnv, sanitise
from jumper_warp.rl.cfg import PpoCfg, ShacCfg
from jumper_warp.rl.networks import ActorCritic
from jumper_warp.rl.ppo import take_averages
from jumper_warp.utils.errors import InputError
from jumper_warp.utils.state_checks import check_parts, check_tensor

STATISTICS = ("actor", "value", "gradient_actor", "gradient_critic")
"""Names of the statistics that `Shac.statistics` averages over iterations."""


class Window(NamedTuple):
    """Result of a window of a few policy steps of all worlds: the actor's loss, and samples for training the critic."""

    loss: torch.Tensor  # () actor loss, differentiable
    obs: torch.Tensor  # (num_steps, num_envs, num_obs)
    critic_obs: torch.Tensor  # (num_steps, num_envs, num_critic_obs)
    reward: torch.Tensor  # (num_steps, num_envs) times `PpoCfg.reward_scale`
    next_value: torch.Tensor  # (num_steps, num_envs) target critic's value after the step; 0 after a termination
    done: torch.Tensor  # (num_steps, num_envs) 1 where the episode ended


class Shac:
    """Short-horizon actor-critic (SHAC) on one environment, with the interface of `Ppo` that `TrainingRun` uses."""

    def __init__(self, env: DifferentiableVecEnv, cfg: PpoCfg, shac: ShacCfg) -> None:
        """Build networks on the environment's device; the weights follow torch's CPU seed.

        Raises InputError: the environment has no gradients.
        """
        if not hasattr(env, "step_with_gradient"):
            raise InputError("trainer shac needs an environment with gradients")
        self.env, self.cfg, self.shac = env, cfg, shac
        self.batch_size = cfg.num_steps * env.num_envs
        num_critic_obs = env.num_critic_obs if cfg.asymmetric_critic else env.num_obs
        self.model = ActorCritic(
            env.num_obs, env.num_actions, cfg.hidden, cfg.activation, cfg.init_std, num_critic_obs,
        ).to(env.device)  # fmt: skip
        self.target = copy.deepcopy(self.model.critic).requires_grad_(False)
        self._actor = [*self.model.actor.parameters(), self.model.log_std]
        self._critic = list(self.model.critic.parameters())
        self.optimisers = {
            "actor": torch.optim.Adam(self._actor, shac.lr, (0.7, 0.95)),
            "critic": torch.optim.Adam(self._critic, shac.critic_lr, (0.7, 0.95)),
        }
        self.lr = torch.tensor(shac.lr)
        self.episode = torch.zeros(2, env.num_envs, device=env.device, dtype=torch.float64)  # return, length so far
        self._finished = torch.zeros(3, device=env.device, dtype=torch.float64)  # as `Collector.finished`, summed
        self._sums = torch.zeros(len(STATISTICS) + 1, dtype=torch.float64)  # and the number of iterations

    def compile(self) -> None:
        """Do nothing; SHAC compiles no functions (part of the interface of `Ppo`)."""

    def close(self) -> None:
        """Do nothing; SHAC has no CUDA graphs (part of the interface of `Ppo`)."""

    def iterate(self, mark: Callable[[], None] = lambda: None) -> None:
        """Update actor and critic on one window of simulation; mark: called after each of the two updates."""
        window = self.window()
        for group in self.optimisers["actor"].param_groups:
            group["lr"] = float(self.lr)
        actor_norm = self._optimiser_step("actor", self._actor, window.loss, self.shac.max_grad_norm)
        mark()
        value_loss, critic_norm = self._update_critic(window)
        mark()
        self._sums += torch.tensor([float(window.loss.detach()), value_loss, actor_norm, critic_norm, 1.0]).double()

    def window(self) -> Window:
        """Simulate a window of `num_steps` policy steps; return the actor's loss and samples to train the critic."""
        env, cfg, model = self.env, self.cfg, self.model
        samples: list[tuple[torch.Tensor, ...]] = []
        discount, total = torch.ones(env.num_envs, device=env.device), torch.zeros(env.num_envs, device=env.device)
        env.begin_window()
        for step in range(cfg.num_steps):
            obs, critic_obs = env.observe()
            mean = model.mean(model.features(obs))
            noise = torch.randn_like(mean)
            action = mean + model.log_std.exp() * noise
            reward = cfg.reward_scale * torch.nan_to_num(env.step_with_gradient(action), 0.0, 0.0, 0.0)
            done, timeout = env.done.clone(), env.timeout.clone()
            final_value = self._target_value(env.observe_final()[int(cfg.asymmetric_critic)]) * timeout
            if step == cfg.num_steps - 1:
                next_value = self._target_value(env.observe()[int(cfg.asymmetric_critic)])
            else:
                next_value = self._target_value((env.critic_obs if cfg.asymmetric_critic else env.obs).clone()).detach()
            value = torch.where(done > 0.0, final_value, next_value)
            sample = (obs, critic_obs if cfg.asymmetric_critic else obs, reward, value, done)
            samples.append(tuple(x.detach() for x in sample))
            total = total + discount * reward
            discount = discount * cfg.gamma
            ends = torch.ones_like(done) if step == cfg.num_steps - 1 else done
            total = total + ends * discount * value
            discount = torch.where(done > 0.0, 1.0, discount)
            self._count_episodes(reward.detach() / cfg.reward_scale, done)
        loss = -total.mean() / cfg.num_steps - self.shac.entropy_coef * model.log_std.sum()  # entropy up to a constant
        return Window(loss, *(torch.stack(x) for x in zip(*samples, strict=True)))

    def _target_value(self, critic_obs: torch.Tensor) -> torch.Tensor:
        """Return the target critic's expected return (num_envs,) for raw observations (num_envs, num_critic_obs)."""
        output = self.target(self.model.critic_features(critic_obs)).squeeze(-1)
        return self.model.value_moments.scaling().denormalise(output)

    def _count_episodes(self, reward: torch.Tensor, done: torch.Tensor) -> None:
        """Add a step's reward and done, (num_envs,), to the returns and lengths of current and finished episodes."""
        running = self.episode + torch.stack([reward, torch.ones_like(reward)])
        self._finished += torch.cat([(running * done).sum(1), done.sum()[None].double()])
        self.episode = running * (1.0 - done)

    def _update_critic(self, window: Window) -> tuple[float, float]:
        """Fit the critic to TD(lambda) returns, and update running statistics and target critic.

        Return the mean value loss and the mean gradient norm over the optimiser steps.
        """
        cfg, shac, model = self.cfg, self.shac, self.model
        _, obs, critic_obs, reward, next_value, done = window
        returns, next_return = torch.zeros_like(reward), next_value[-1]
        for step in reversed(range(len(reward))):
            mixed = (1.0 - cfg.lam) * next_value[step] + cfg.lam * next_return
            mixed = torch.where(done[step] > 0.0, next_value[step], mixed)
            next_return = returns[step] = reward[step] + cfg.gamma * mixed
        model.obs_moments.update(sanitise(obs.flatten(0, 1)))
        model.critic_moments.update(sanitise(critic_obs.flatten(0, 1)))
        if cfg.normalise_value:
            model.value_moments.update(returns.flatten())
        features = model.critic_features(critic_obs.flatten(0, 1))
        target = model.value_moments.scaling().normalise(returns.flatten())
        losses, norms = [], []
        for _ in range(shac.critic_epochs):
            for rows in torch.randperm(len(target), device=target.device).chunk(shac.critic_minibatches):
                loss = functional.mse_loss(model.value_head(features[rows]), target[rows])
                norms.append(self._optimiser_step("critic", self._critic, loss, cfg.max_grad_norm))
                losses.append(float(loss.detach()))
        with torch.no_grad():
            for target_param, param in zip(self.target.parameters(), self._critic, strict=True):
                target_param.lerp_(param, shac.target_rate)
        return sum(losses) / len(losses), sum(norms) / len(norms)

    def _optimiser_step(self, name: str, params: Sequence[torch.Tensor], loss: torch.Tensor, max_norm: float) -> float:
        """Update actor or critic by a gradient step on a loss; return the gradient's norm before clipping.

        A gradient that is not finite is skipped.
        """
        optimiser = self.optimisers[name]
        optimiser.zero_grad()
        loss.backward(inputs=params)
        norm = float(torch.nn.utils.clip_grad_norm_(params, max_norm))
        if norm < float("inf"):
            optimiser.step()
        return norm

    def set_progress(self, progress: float) -> None:
        """Set the actor's learning rate, which falls linearly with the training's progress (0 to 1) to a tenth."""
        self.lr.fill_(self.shac.lr * (1.0 - 0.9 * min(max(progress, 0.0), 1.0)))

    def statistics(self) -> dict[str, float]:
        """Return mean losses and mean episode return and length since the last call."""
        return take_averages(STATISTICS, self._sums, self._finished, self.lr, self.model.log_std)

    def _parts(self) -> dict[str, torch.Tensor]:
        """Return all tensors of the training state by dotted name, uncopied; missing optimiser states become zeros."""
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
        """Return copies of all tensors of the training state by name; `model` is a nested dict of the networks."""
        rest = {name: value.detach().clone() for name, value in self._parts().items() if not name.startswith("model.")}
        return {"model": {name: value.clone() for name, value in self.model.state_dict().items()}, **rest}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore networks, optimisers and episode counts from the result of `state_dict`.

        Raises InputError: a part is missing, unknown or of another form.
        """
        flat = {f"model.{name}": value for name, value in state["model"].items()}
        flat |= {name: value for name, value in state.items() if name != "model"}
        parts = self._parts()
        check_parts(flat, parts, "shac")
        for name, like in parts.items():
            check_tensor(flat[name], like, f"shac.{name}")
        with torch.no_grad():
            for name, tensor in parts.items():
                tensor.copy_(flat[name])
