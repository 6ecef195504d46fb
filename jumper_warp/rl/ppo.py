"""Proximal policy optimisation (PPO) with normalised observations, returns and advantages.

An iteration is `collect`, then `update`: CUDA graphs on a GPU, eager on a CPU. There is no host synchronisation within
an iteration. Surrogate: Schulman et al. 2017; advantage: Schulman et al. 2016. The learning rate adapts to the KL
divergence.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import torch

from jumper_warp.envs.vec_env import VecEnv
from jumper_warp.rl.cfg import PpoCfg
from jumper_warp.rl.distributed import all_reduce_mean
from jumper_warp.rl.flat import (
    AdamVectors,
    FlatAdam,
    FlatParameters,
    adam_step,
    adapted_lr,
    clip_gradient,
    flatten_aligned,
)
from jumper_warp.rl.graphs import CapturedProcedure
from jumper_warp.rl.mirror import symmetry_of
from jumper_warp.rl.networks import ActorCritic, ActorTensors, Layers, gaussian_kl, gaussian_log_prob
from jumper_warp.rl.rollout import Collector
from jumper_warp.rl.samples import Batch, BatchPacker, RowLayout
from jumper_warp.utils.allocator import keep_freed_memory
from jumper_warp.utils.errors import InputError
from jumper_warp.utils.state_checks import check_parts, check_tensor, check_values


class ActorLosses(NamedTuple):
    """PPO's surrogate loss, and entropy, left-right asymmetry and KL divergence of the policy, on a minibatch."""

    surrogate: torch.Tensor  # clipped surrogate loss, lower is better
    entropy: torch.Tensor  # entropy of the policy [nat]
    asymmetry: torch.Tensor  # mean square of f(x) - N f(M x), see `jumper_warp.rl.mirror`; 0 without symmetry
    kl: torch.Tensor  # KL(old ‖ new) [nat]


class StepStatistics(NamedTuple):
    """Losses, KL divergence and gradient norms at the start of an optimiser step, each () (see `ActorLosses`)."""

    surrogate: torch.Tensor
    value: torch.Tensor  # value loss before weighting [variances of the return]
    entropy: torch.Tensor
    asymmetry: torch.Tensor
    kl: torch.Tensor  # KL(old ‖ new) [nat], over all ranks
    gradient_actor: torch.Tensor  # norm of the actor's gradient before clipping, averaged over all ranks
    gradient_critic: torch.Tensor  # norm of the critic's gradient, likewise
    skipped: torch.Tensor  # 1 if a gradient was not finite and was replaced by 0


STATISTICS = StepStatistics._fields  # Names of the statistics that `Ppo.statistics` averages over minibatches


class Ppo:
    """PPO trainer: `collect` fills the rollout, `update` trains actor and critic on it, `iterate` does both."""

    def __init__(self, env: VecEnv, cfg: PpoCfg) -> None:
        """Build actor, critic and rollout buffers on the environment's device; weights follow torch's CPU seed.

        Raises InputError as `PpoCfg.batch_size`, and as `symmetry_of` if symmetry is requested.
        """
        self.batch_size = cfg.batch_size(env.num_envs)
        self.env, self.cfg = env, cfg
        cuda = env.device.type == "cuda"
        if cuda:
            torch.set_float32_matmul_precision("high" if cfg.tf32 else "highest")
        else:
            keep_freed_memory()
        num_critic_obs = env.num_critic_obs if cfg.asymmetric_critic else env.num_obs
        symmetry = None if cfg.symmetry == "off" else symmetry_of(env)
        self.model = ActorCritic(
            env.num_obs, env.num_actions, cfg.hidden, cfg.activation, cfg.init_std, num_critic_obs, symmetry,
        ).to(env.device)  # fmt: skip
        self.flat = FlatParameters(self.model, cfg.activation)
        self.optimiser = FlatAdam(self.flat, cfg.lr)
        self.lr = self.optimiser.lr
        self._desired_kl = torch.full((), cfg.desired_kl, device=env.device)
        self._entropy_coef = torch.full((), cfg.entropy_coef, device=env.device)
        self.collector = Collector(env, cfg, self.model, self.flat)
        self.rollout = self.collector.rollout
        self.packer = BatchPacker(self.rollout, cfg, self.model, self.flat, symmetry and symmetry.obs)
        self._minibatch = self.packer.rows.new_zeros(self.batch_size // cfg.minibatches, self.packer.rows.shape[1])
        self._orders = torch.zeros(cfg.epochs, self.batch_size, dtype=torch.int64, device=env.device)
        counts = {"dtype": torch.float64, "device": env.device}  # float32 counts to 2^24 only
        self._sums = torch.zeros(len(STATISTICS) + 1, **counts)  # sums of the statistics, and the number of steps
        procedures: tuple[Callable[[], object], ...] = (self.collector.roll, self.batch, self._run_epochs)
        self._roll, self._batch, self._optimise = (CapturedProcedure(each, cuda and cfg.graphs) for each in procedures)

    def iterate(self, mark: Callable[[], None] = lambda: None) -> None:
        """Collect a rollout, and update the networks on it; call `mark` after launching each of the two."""
        self.collect()
        mark()
        self.update()
        mark()

    def collect(self) -> None:
        """Run the current policy in the environment for one rollout, and store all transitions in `rollout`."""
        self._roll()

    def update(self) -> None:
        """Optimise the networks on the rollout for all epochs."""
        self._batch()
        self._optimise()

    def compile(self) -> None:
        """Do nothing; PyTorch's functions run eagerly (`FusedPpo` compiles kernels)."""

    @torch.no_grad()
    def batch(self) -> Batch:
        """Compute and return the rollout's training samples, time-major, and update the normalisation statistics.

        The samples are views of `packer.rows`.
        Also samples the order of the samples in every epoch.
        """
        self.packer.pack()
        for order in self._orders:
            order.copy_(self.order())
        return self.packer.layout.split(self.packer.rows)

    def order(self) -> torch.Tensor:
        """Return a random permutation of the batch's samples, (batch_size,) int64."""
        return torch.rand(self.batch_size, device=self.env.device).argsort()

    @torch.no_grad()
    def _run_epochs(self) -> None:
        """Run one optimiser step per minibatch for all epochs."""
        for order in self._orders:
            for samples in order.chunk(self.cfg.minibatches):
                torch.index_select(self.packer.rows, 0, samples, out=self._minibatch)
                self.minibatch_step(self._minibatch)

    @torch.no_grad()
    def minibatch_step(self, rows: torch.Tensor) -> StepStatistics:
        """Run one optimiser step on a minibatch, without host synchronisation; return its losses and gradient norms.

        `statistics` averages them.
        rows: samples (batch, columns of `packer.layout`).
        """
        flat, packer, cfg = self.flat, self.packer, self.cfg
        value_loss = critic_gradient(rows, packer.layout, flat.critic, cfg, flat.critic_gradient)
        losses = actor_gradient(
            rows, packer.layout, flat.actor, packer.old_log_std, self._entropy_coef, cfg, flat.actor_gradient
        )
        flat.kl.copy_(losses.kl)
        all_reduce_mean(flat.all_reduced)  # gradient and divergence
        return optimiser_step(
            self.optimiser.vectors, flat.actor_size, flat.kl, self._desired_kl, cfg, losses, value_loss, self._sums
        )

    def set_progress(self, progress: float) -> None:
        """Set the desired KL divergence and the entropy coefficient for the training's progress (0: start, 1: end).

        Both are constant in the first half, and interpolated linearly to their final values in the second half. Does
        not synchronise with the device.
        """
        cfg, decay = self.cfg, min(max(2.0 * progress - 1.0, 0.0), 1.0)
        self._desired_kl.fill_((1.0 - decay) * cfg.desired_kl + decay * min(cfg.final_desired_kl, cfg.desired_kl))
        final = cfg.entropy_coef if cfg.final_entropy_coef is None else cfg.final_entropy_coef
        self._entropy_coef.fill_((1.0 - decay) * cfg.entropy_coef + decay * final)

    def statistics(self) -> dict[str, float]:
        """Return mean losses and mean episode return and length since the last call; synchronises with the device."""
        *totals, count = self._sums.tolist()
        metrics = {f"Loss/{name}": total / max(count, 1.0) for name, total in zip(STATISTICS, totals, strict=True)}
        metrics |= {"Loss/learning_rate": self.lr.item(), "Policy/mean_std": self.model.log_std.exp().mean().item()}
        finished = self.collector.finished
        total_return, total_length, episodes = finished.view(3, -1).sum(1).tolist()
        if episodes > 0.0:
            means = {"Train/mean_reward": total_return / episodes, "Train/mean_episode_length": total_length / episodes}
            metrics |= means
        self._sums.zero_()
        finished.zero_()
        return metrics

    def state_dict(self) -> dict[str, Any]:
        """Return the training's state as nested dicts of tensors: `model`, `optimiser`, `lr` and `episode`."""
        model = self.model.state_dict()
        return {
            "model": {name: value.clone(memory_format=torch.contiguous_format) for name, value in model.items()},
            "optimiser": self.optimiser.state_dict(),
            "lr": self.lr,
            "episode": self.collector.episode,
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore the training's state from the result of `state_dict`: networks, optimiser, rate and episode counts.

        The rate is limited to `min_lr` and `max_lr`.
        Raises InputError: a part is missing, unknown, of another shape or type, or not finite; nothing is changed.
        """
        self._check_state(state)
        self.model.load_state_dict(state["model"])
        self.optimiser.load_state_dict(state["optimiser"])
        self.lr.copy_(state["lr"]).clamp_(self.cfg.min_lr, self.cfg.max_lr)
        self.collector.episode.copy_(state["episode"])

    def _check_state(self, state: Any) -> None:
        """Raise InputError unless all parts of a state are finite and have the right shapes and types."""
        check_parts(state, ("model", "optimiser", "lr", "episode"), "ppo")
        model = self.model.state_dict()
        check_parts(state["model"], model, "ppo.model")
        for name, like in model.items():
            value, where = state["model"][name], f"ppo.model.{name}"
            check_tensor(value, like, where)
            if name.startswith("mirror_") and not torch.equal(value, like.to(value.device)):
                raise InputError(f"{where} is for another observation or action")
            check_values(value, where, 0.0 if name.endswith((".var", ".count")) else -math.inf)
        check_parts(state["optimiser"], range(len(self.flat.params)), "ppo.optimiser")
        for index, param in enumerate(self.flat.params):
            moments, where = state["optimiser"][index], f"ppo.optimiser.{index}"
            check_parts(moments, ("step", "exp_avg", "exp_avg_sq"), where)
            expected = (("step", self.lr, 0.0), ("exp_avg", param, -math.inf), ("exp_avg_sq", param, 0.0))
            for name, like, minimum in expected:
                check_tensor(moments[name], like, f"{where}.{name}")
                check_values(moments[name], f"{where}.{name}", minimum)
        check_tensor(state["lr"], self.lr, "ppo.lr")
        check_values(state["lr"], "ppo.lr", 0.0)
        check_tensor(state["episode"], self.collector.episode, "ppo.episode", (torch.float32,))
        check_values(state["episode"], "ppo.episode")

    def close(self) -> None:
        """Delete all CUDA graphs; required before the process group is destroyed."""
        for graph in (self._roll, self._batch, self._optimise):
            graph.close()


def critic_gradient(
    rows: torch.Tensor, layout: RowLayout, critic: Layers, cfg: PpoCfg, out: torch.Tensor
) -> torch.Tensor:
    """Compute the gradient of PPO's value loss with respect to the critic's parameters.

    Writes the gradient of the weighted loss to `out`, and returns the value loss () before weighting. The loss is the
    squared error; with `clip_value` the maximum of this and of the squared error of a value clipped to within `clip` of
    the rollout's value.

    rows: (batch, columns of `layout`); out: the critic's slice of the flat gradient.
    """
    batch = layout.split(rows)
    output, layer_inputs = critic.forward(layout.critic_features(rows))
    value_change = output.squeeze(-1) - batch.value
    error = output.squeeze(-1) - batch.target
    loss, grad = error.square(), error
    if cfg.clip_value:
        clipped_error = batch.value + value_change.clamp(-cfg.clip, cfg.clip) - batch.target
        grad = torch.where(clipped_error.square() > loss, clipped_error * (value_change.abs() <= cfg.clip), error)
        loss = torch.maximum(loss, clipped_error.square())
    grad_output = grad * (2.0 * cfg.value_coef / rows.shape[0])
    out.copy_(flatten_aligned(critic.backward(layer_inputs, grad_output[:, None])))
    return loss.mean()


def actor_gradient(
    rows: torch.Tensor, layout: RowLayout, actor: ActorTensors, old_log_std: torch.Tensor, entropy_coef: torch.Tensor,
    cfg: PpoCfg, out: torch.Tensor,
) -> ActorLosses:  # fmt: skip
    """Compute the gradient of PPO's surrogate loss and entropy bonus with respect to actor and noise.

    Writes it to `out`, and returns the losses. The clipped surrogate of Schulman et al. 2017, eq. 7, as a loss:
    -E[min(r A, clip(r) A)] with r = π(a) / π_old(a). Where r A is the smaller, ∂/∂log π = -r A / batch, else 0.

    rows: (batch, columns of `layout`); entropy_coef: (); out: the slice of actor and noise of the flat gradient.
    """
    batch, log_std = layout.split(rows), actor.log_std
    mean, difference, layer_inputs = actor.forward(layout.features(rows))
    ratio = torch.exp(gaussian_log_prob(batch.action, mean, log_std) - batch.log_prob)
    objective = batch.advantage * ratio
    clipped = batch.advantage * ratio.clamp(1.0 - cfg.clip, 1.0 + cfg.clip)
    grad_log_prob = torch.where(objective > clipped, 0.0, objective)[:, None] / -rows.shape[0]
    z = (batch.action - mean) * torch.exp(-log_std)
    grad_log_std = (grad_log_prob * (z.square() - 1.0)).sum(0) - entropy_coef
    gradients = actor.backward(layer_inputs, grad_log_prob * z * torch.exp(-log_std))
    out.copy_(flatten_aligned([*gradients, grad_log_std]))
    entropy = (log_std + 0.5 * math.log(2.0 * math.pi * math.e)).sum()
    kl = gaussian_kl(batch.mean, old_log_std, mean, log_std).mean()
    return ActorLosses(-torch.minimum(objective, clipped).mean(), entropy, difference.square().mean(), kl)


def optimiser_step(
    vectors: AdamVectors, actor_size: int, kl: torch.Tensor, desired_kl: torch.Tensor, cfg: PpoCfg, losses: ActorLosses,
    value_loss: torch.Tensor, sums: torch.Tensor,
) -> StepStatistics:  # fmt: skip
    """Run one step of Adam with an adapted learning rate and a clipped gradient; return losses and gradient norms.

    The rate adapts to the KL divergence kl (). A non-finite gradient is replaced by 0. sums: (len(STATISTICS) + 1,)
    running sums of the statistics, and the number of steps; updated in place.
    """
    vectors.lr.copy_(adapted_lr(vectors.lr, kl, cfg, desired_kl))
    norms = clip_gradient(vectors.gradient, actor_size, cfg.max_grad_norm)
    adam_step(vectors)
    skipped = 1.0 - norms.isfinite().all().float()
    surrogate, entropy, asymmetry, _ = losses
    step = StepStatistics(surrogate, value_loss, entropy, asymmetry, kl.clone(), norms[0], norms[1], skipped)
    sums.add_(torch.nan_to_num(torch.stack([*step, torch.ones_like(kl)]), nan=0.0, posinf=0.0, neginf=0.0))
    return step
