"""Proximal policy optimisation. One iteration is `collect` and then `update`: CUDA graphs on a GPU, eager on a CPU.

Nothing between the first action and the last optimiser step waits for the host. Schulman et al. 2017 for the surrogate,
2016 for the advantage; observations, returns and advantages are normalised, the step size follows the KL divergence.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import torch

from jumper_warp.envs.vec_env import VecEnv, sanitise
from jumper_warp.rl.cfg import PpoCfg
from jumper_warp.rl.distributed import average_over_ranks, world_size
from jumper_warp.rl.graphs import Captured
from jumper_warp.rl.networks import ActorCritic, batch_moments, gaussian_kl, gaussian_log_prob
from jumper_warp.rl.state_checks import check_ppo

STATISTICS = ("surrogate", "value", "entropy", "kl", "gradient_actor", "gradient_critic", "skipped")
"""What `Ppo.statistics` averages over minibatches; skipped is the share of steps with a non-finite gradient."""

FIGURES = (
    *(f"Loss/{name}" for name in STATISTICS), "Loss/learning_rate", "Policy/mean_std", "Train/mean_return",
    "Train/mean_length",
)  # fmt: skip
"""Names of all that `Ppo.statistics` returns; those of Train/ once an episode has ended."""


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


class Batch(NamedTuple):
    """Samples to learn from; first axis: sample."""

    features: torch.Tensor
    """(batch, num_obs) normalised observations."""
    critic_features: torch.Tensor
    """(batch, num_critic_obs) the critic's, normalised."""
    action: torch.Tensor
    mean: torch.Tensor
    """(batch, num_actions) mean of the policy that acted."""
    log_prob: torch.Tensor
    """(batch,) of the action under that policy."""
    value: torch.Tensor
    """(batch,) the critic's output then."""
    advantage: torch.Tensor
    target: torch.Tensor
    """(batch,) what the critic should have put out."""


class Losses(NamedTuple):
    """Scalars of one minibatch."""

    total: torch.Tensor
    surrogate: torch.Tensor
    value: torch.Tensor
    entropy: torch.Tensor
    kl: torch.Tensor


def gae(
    reward: torch.Tensor, done: torch.Tensor, value: torch.Tensor, gamma: float, lam: float
) -> tuple[torch.Tensor, torch.Tensor]:
    """Generalised advantage estimation.

    Args:
        reward: (steps, num_envs), with the bootstrap of timeouts already in it.
        done: (steps, num_envs), 1 where nothing follows.
        value: (steps + 1, num_envs) expected return before each step and after the last.
        gamma: Discount per step.
        lam: Weight of longer estimates.

    Returns:
        Advantages and returns, each (steps, num_envs).
    """
    alive = 1.0 - done
    delta = reward + gamma * alive * value[1:] - value[:-1]
    decay = gamma * lam * alive
    advantage = torch.empty_like(reward)
    following = torch.zeros_like(reward[0])
    for step in reversed(range(reward.shape[0])):
        following = torch.addcmul(delta[step], decay[step], following)
        advantage[step] = following
    return advantage, advantage + value[:-1]


def losses(model: ActorCritic, batch: Batch, old_log_std: torch.Tensor, cfg: PpoCfg) -> Losses:
    """Return the losses of a minibatch; `total` is what to descend, `kl` has no gradient."""
    mean = model.actor(batch.features)
    ratio = torch.exp(gaussian_log_prob(batch.action, mean, model.log_std) - batch.log_prob)
    clipped_ratio = ratio.clamp(1.0 - cfg.clip, 1.0 + cfg.clip)
    surrogate = -torch.min(batch.advantage * ratio, batch.advantage * clipped_ratio).mean()
    value = model.value_head(batch.critic_features)
    value_loss = (value - batch.target).square()
    if cfg.clip_value:
        near = batch.value + (value - batch.value).clamp(-cfg.clip, cfg.clip)
        value_loss = torch.max(value_loss, (near - batch.target).square())
    value_loss = value_loss.mean()
    entropy = (model.log_std + 0.5 * math.log(2.0 * math.pi * math.e)).sum()
    total = surrogate + cfg.value_coef * value_loss - cfg.entropy_coef * entropy
    with torch.no_grad():
        kl = gaussian_kl(batch.mean, old_log_std, mean, model.log_std).mean()
    return Losses(total, surrogate, value_loss, entropy, kl)


def adapted_lr(
    lr: torch.Tensor, kl: torch.Tensor, cfg: PpoCfg, desired_kl: torch.Tensor | float | None = None
) -> torch.Tensor:
    """Return the step size after a divergence: 1.5 times smaller above twice the desired one, larger below half."""
    if cfg.desired_kl <= 0.0:
        return lr
    desired_kl = cfg.desired_kl if desired_kl is None else desired_kl
    slower = torch.where(kl > 2.0 * desired_kl, (lr / 1.5).clamp(min=cfg.min_lr), lr)
    too_slow = (kl < 0.5 * desired_kl) & (kl > 0.0)
    return torch.where(too_slow, (lr * 1.5).clamp(max=cfg.max_lr), slower)


class Ppo:
    """The algorithm on one environment: `collect` fills the rollout, `update` learns from it."""

    def __init__(self, env: VecEnv, cfg: PpoCfg) -> None:
        """Build networks and buffers on the environment's device; the weights follow torch's CPU seed.

        Raises:
            ValueError: As `PpoCfg.batch_size`.
        """
        self.batch_size = cfg.batch_size(env.num_envs)
        self.env, self.cfg = env, cfg
        cuda = env.device.type == "cuda"
        if cuda:
            torch.set_float32_matmul_precision("high" if cfg.tf32 else "highest")
        self._critic_obs = env.critic_obs if cfg.asymmetric else env.obs
        self._final_critic_obs = env.final_critic_obs if cfg.asymmetric else env.final_obs
        num_critic_obs = env.num_critic_obs if cfg.asymmetric else env.num_obs
        self.model = ActorCritic(
            env.num_obs, env.num_actions, cfg.hidden, cfg.activation, cfg.init_std, num_critic_obs
        ).to(env.device)
        actor = [*self.model.actor.parameters(), self.model.log_std]
        critic = list(self.model.critic.parameters())
        self.lr = torch.full((), cfg.lr, device=env.device)
        self._desired_kl = torch.full((), cfg.desired_kl, device=env.device)
        self.update = Captured(self._update, cuda and cfg.graphs and world_size() == 1)
        self.optimiser = torch.optim.Adam([*actor, *critic], lr=self.lr, fused=True, capturable=self.update.enabled)
        self._flatten_gradients(actor, critic)
        self.rollout = RolloutBuffer(cfg.num_steps, env, num_critic_obs)
        counts = {"dtype": torch.float64, "device": env.device}  # float32 counts to 2^24 only
        self._sums = torch.zeros(len(STATISTICS), **counts)
        self._sum_count = torch.zeros((), **counts)
        self._episode = torch.zeros(2, env.num_envs, **counts)  # return and length so far
        self._finished = torch.zeros(3, **counts)  # sums of return and length, count
        self.collect = Captured(self._collect, cuda and cfg.graphs)

    def _flatten_gradients(self, actor: list[torch.nn.Parameter], critic: list[torch.nn.Parameter]) -> None:
        """Make all gradients views of one vector, whose last entry carries the divergence to the other ranks."""
        params = [*actor, *critic]
        self._vector = torch.zeros(sum(p.numel() for p in params) + 1, device=self.env.device)
        first = 0
        for param in params:
            param.grad = self._vector[first : first + param.numel()].view_as(param)
            first += param.numel()
        split = sum(p.numel() for p in actor)
        self._gradients = (self._vector[:split], self._vector[split:-1])

    @torch.no_grad()
    def _collect(self) -> None:
        env, model, rollout = self.env, self.model, self.rollout
        rollout.log_std.copy_(model.log_std)
        std = rollout.log_std.exp()
        for step in range(self.cfg.num_steps):
            self._observe(step)
            mean = model.actor(model.features(rollout.obs[step]))
            rollout.mean[step] = mean
            rollout.action[step] = mean + std * torch.randn_like(mean)
            env.step(rollout.action[step])
            reward = torch.nan_to_num(env.reward, nan=0.0, posinf=0.0, neginf=0.0)
            rollout.reward[step] = reward * self.cfg.reward_scale
            rollout.done[step] = env.done
            rollout.timeout[step] = env.timeout
            rollout.final_critic_obs[step] = self._final_critic_obs
            self._count_episodes(reward, rollout.done[step])
        self._observe(-1)

    def _observe(self, step: int) -> None:
        sanitise(self.env.obs, out=self.rollout.obs[step])
        sanitise(self._critic_obs, out=self.rollout.critic_obs[step])

    def _count_episodes(self, reward: torch.Tensor, done: torch.Tensor) -> None:
        self._episode[0] += reward
        self._episode[1] += 1.0
        self._finished[:2] += (self._episode * done).sum(1)
        self._finished[2] += done.sum()
        self._episode *= 1.0 - done

    @torch.no_grad()
    def batch(self) -> Batch:
        """Return the rollout as samples, time-major, and take it into the running statistics."""
        cfg, model, rollout = self.cfg, self.model, self.rollout
        critic_features = model.critic_features(rollout.critic_obs)
        head = model.value_head(critic_features)
        reward = rollout.reward + cfg.gamma * rollout.timeout * model.value(rollout.final_critic_obs)
        advantage, target = gae(reward, rollout.done, model.value_moments.restore(head), cfg.gamma, cfg.lam)
        mean, var, count = batch_moments(advantage.flatten())
        std = (var * count / (count - 1)).sqrt()
        advantage = (advantage - mean.float()) / (std + 1.0e-8).float()
        if cfg.normalise_value:
            model.value_moments.update(target.flatten())
            target = model.value_moments.normalise(target)
        features = model.features(rollout.obs[:-1])
        model.obs_moments.update(rollout.obs[:-1].flatten(0, 1))
        model.critic_moments.update(rollout.critic_obs[:-1].flatten(0, 1))
        log_prob = gaussian_log_prob(rollout.action, rollout.mean, rollout.log_std)
        acted = (rollout.action, rollout.mean, log_prob)
        parts = (features, critic_features[:-1], *acted, head[:-1], advantage, target)
        return Batch(*(part.flatten(0, 1) for part in parts))

    def order(self) -> torch.Tensor:
        """Return a random order of the batch's samples, (batch_size,)."""
        return torch.rand(self.batch_size, device=self.env.device).argsort()

    def _update(self) -> None:
        batch = self.batch()
        for _ in range(self.cfg.epochs):
            for samples in self.order().chunk(self.cfg.minibatches):
                self._descend(Batch(*(part.index_select(0, samples) for part in batch)))

    def _descend(self, minibatch: Batch) -> None:
        """Make one optimiser step; a non-finite gradient counts as none."""
        self._vector.zero_()
        found = losses(self.model, minibatch, self.rollout.log_std, self.cfg)
        found.total.backward()
        with torch.no_grad():
            self._vector[-1] = found.kl
            average_over_ranks(self._vector)
            kl = self._vector[-1].clone()
            norms = torch.stack([part.norm() for part in self._gradients])
            for part, norm in zip(self._gradients, norms, strict=True):
                part.mul_((self.cfg.max_grad_norm / (norm + 1.0e-6)).clamp(max=1.0))
            self._vector.nan_to_num_(nan=0.0, posinf=0.0, neginf=0.0)
            self.lr.copy_(adapted_lr(self.lr, kl, self.cfg, self._desired_kl))
            self.optimiser.step()
            skipped = 1.0 - norms.isfinite().all().float()
            terms = torch.stack([found.surrogate, found.value, found.entropy, kl, *norms, skipped])
            self._sums += torch.nan_to_num(terms, nan=0.0, posinf=0.0, neginf=0.0)
            self._sum_count += 1.0

    def set_progress(self, progress: float) -> None:
        """Tell how much of the training is over, from 0 to 1; does not wait for the device."""
        late = min(max(2.0 * progress - 1.0, 0.0), 1.0)
        self._desired_kl.fill_((1.0 - late) * self.cfg.desired_kl + late * min(self.cfg.final_kl, self.cfg.desired_kl))

    def statistics(self) -> dict[str, float]:
        """Return averages since the last call, of losses and of finished episodes; waits for the device."""
        sums, count, finished = self._sums.tolist(), self._sum_count.item(), self._finished.tolist()
        result = {f"Loss/{name}": total / max(count, 1.0) for name, total in zip(STATISTICS, sums, strict=True)}
        result["Loss/learning_rate"] = self.lr.item()
        result["Policy/mean_std"] = self.model.log_std.exp().mean().item()
        if finished[2] > 0.0:
            result["Train/mean_return"] = finished[0] / finished[2]
            result["Train/mean_length"] = finished[1] / finished[2]
        for total in (self._sums, self._sum_count, self._finished):
            total.zero_()
        return result

    def state_dict(self) -> dict[str, Any]:
        """Return networks, statistics and optimiser, tensors only."""
        return {
            "model": self.model.state_dict(),
            "optimiser": self.optimiser.state_dict()["state"],
            "lr": self.lr,
            "episode": self._episode,
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Take up what `state_dict` gave.

        Raises:
            ValueError: A part is missing, unknown, of another shape or type, or not finite; nothing is changed.
        """
        (group,) = self.optimiser.param_groups
        check_ppo(state, self.model.state_dict(), group["params"], self.lr, self._episode)
        self.model.load_state_dict(state["model"])
        moments = {i: {k: x.clone() for k, x in each.items()} for i, each in state["optimiser"].items()}
        self.optimiser.load_state_dict({**self.optimiser.state_dict(), "state": moments})
        for group in self.optimiser.param_groups:
            group["lr"] = self.lr
        self.lr.copy_(state["lr"])
        self._episode.copy_(state["episode"])
        self.collect.forget()
        self.update.forget()
