"""Proximal policy optimisation. One iteration is `collect` and then `update`: CUDA graphs on a GPU, eager on a CPU.

Nothing between the first action and the last optimiser step waits for the host. Schulman et al. 2017 for the surrogate,
2016 for the advantage; observations, returns and advantages are normalised, the step size follows the KL divergence.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import torch

from jumper_warp.envs.vec_env import VecEnv
from jumper_warp.rl.cfg import PpoCfg
from jumper_warp.rl.distributed import all_reduce_mean
from jumper_warp.rl.flat import AdamVectors, FlatAdam, FlatParameters, adam_step, adapted_lr, clip_gradient, joined
from jumper_warp.rl.graphs import CapturedProcedure, Compiler
from jumper_warp.rl.mirror import symmetry_of
from jumper_warp.rl.networks import DTYPES, Actor, ActorCritic, Layers, gaussian_kl, gaussian_log_prob
from jumper_warp.rl.rollout import Collector
from jumper_warp.rl.samples import Batch, BatchPacker, RowLayout
from jumper_warp.utils.allocator import keep_freed_memory
from jumper_warp.utils.errors import InputError
from jumper_warp.utils.state_checks import check_parts, check_tensor, check_values


class ActorLosses(NamedTuple):
    """Of a minibatch, each ()."""

    surrogate: torch.Tensor
    entropy: torch.Tensor
    """Of the policy [nat]."""
    asymmetry: torch.Tensor
    """Mean square of f(x) - N f(M x), see `jumper_warp.rl.mirror`; 0 without symmetry."""
    kl: torch.Tensor
    """KL(old ‖ new) [nat]."""


class StepStatistics(NamedTuple):
    """Of an optimiser step, each (); losses and divergence from before it, as in `ActorLosses`."""

    surrogate: torch.Tensor
    value: torch.Tensor
    """Value loss before weighting [variances of the return]."""
    entropy: torch.Tensor
    asymmetry: torch.Tensor
    kl: torch.Tensor
    """KL(old ‖ new) [nat], over all ranks."""
    gradient_actor: torch.Tensor
    """Norm of the gradient before clipping, over all ranks."""
    gradient_critic: torch.Tensor
    skipped: torch.Tensor
    """1 if a gradient is not finite, and so counts as 0."""


STATISTICS = StepStatistics._fields
"""What `Ppo.statistics` averages over minibatches."""


class Ppo:
    """The algorithm on one environment: `collect` fills the rollout, `update` learns from it, `iterate` does both."""

    def __init__(self, env: VecEnv, cfg: PpoCfg) -> None:
        """Build networks and buffers on the environment's device; the weights follow torch's CPU seed.

        Raises ValueError as `PpoCfg.batch_size`, and as `symmetry_of` if symmetry is requested.
        """
        self.batch_size = cfg.batch_size(env.num_envs)
        self.env, self.cfg = env, cfg
        cuda = env.device.type == "cuda"
        if cuda:
            torch.set_float32_matmul_precision("high" if cfg.tf32 else "highest")
        else:
            keep_freed_memory()
        num_critic_obs = env.num_critic_obs if cfg.asymmetric else env.num_obs
        symmetry = None if cfg.symmetry == "off" else symmetry_of(env)
        self.model = ActorCritic(
            env.num_obs, env.num_actions, cfg.hidden, cfg.activation, cfg.init_std, num_critic_obs, symmetry
        ).to(env.device)  # fmt: skip
        self.flat = FlatParameters(self.model, cfg.activation)
        self.optimiser = FlatAdam(self.flat, cfg.lr)
        self.lr = self.optimiser.lr
        self._desired_kl = torch.full((), cfg.desired_kl, device=env.device)
        self._entropy_coef = torch.full((), cfg.entropy_coef, device=env.device)
        self.compiler = compiler = Compiler(cfg.compile == "on" or (cfg.compile == "auto" and cuda))
        self.collector = Collector(env, cfg, self.model, self.flat, compiler)
        self.rollout = self.collector.rollout
        self.packer = BatchPacker(self.rollout, cfg, self.model, self.flat, compiler, symmetry and symmetry.obs)
        self._minibatch = self.packer.rows.new_zeros(self.batch_size // cfg.minibatches, self.packer.rows.shape[1])
        self._orders = torch.zeros(cfg.epochs, self.batch_size, dtype=torch.int64, device=env.device)
        counts = {"dtype": torch.float64, "device": env.device}  # float32 counts to 2^24 only
        self._sums = torch.zeros(len(STATISTICS) + 1, **counts)  # and their number
        self._actor_gradient, self._critic_gradient = compiler(actor_gradient), compiler(critic_gradient)
        self._optimiser_step = compiler(optimiser_step)
        procedures: tuple[Callable[[], object], ...] = (self.collector.roll, self.batch, self._learn)
        self._roll, self._batch, self._optimise = (CapturedProcedure(each, cuda and cfg.graphs) for each in procedures)

    def iterate(self, mark: Callable[[], None] = lambda: None) -> None:
        """Do one iteration; mark is called when the rollout, and when the update has been launched."""
        self.collect()
        mark()
        self.update()
        mark()

    def collect(self) -> None:
        """Fill the rollout with the present policy."""
        self._roll()

    def update(self) -> None:
        """Learn from the rollout."""
        self._batch()
        self._optimise()

    def prepare(self) -> None:
        """Compile what is to be compiled, and change nothing that a training depends on."""
        if not self.compiler.enabled:
            return
        changed = [*self.optimiser.vectors, self._sums, self.collector.episode, self.collector.finished]
        before = [tensor.clone() for tensor in changed]
        self.collector.warm_up()
        self.packer.warm_up()
        self.minibatch_step(self._minibatch, exchange=False)
        for tensor, value in zip(changed, before, strict=True):
            tensor.copy_(value)

    @torch.no_grad()
    def batch(self) -> Batch:
        """Return the rollout as samples, time-major, and take it into the running statistics; views of `packer.rows`.

        Their orders for all epochs are drawn with them.
        """
        self.packer.pack()
        for order in self._orders:
            order.copy_(self.order())
        return self.packer.layout.split(self.packer.rows)

    def order(self) -> torch.Tensor:
        """Return a random order of the batch's samples, (batch_size,)."""
        return torch.rand(self.batch_size, device=self.env.device).argsort()

    @torch.no_grad()
    def _learn(self) -> None:
        for order in self._orders:
            for samples in order.chunk(self.cfg.minibatches):
                torch.index_select(self.packer.rows, 0, samples, out=self._minibatch)
                self.minibatch_step(self._minibatch)

    @torch.no_grad()
    def minibatch_step(self, rows: torch.Tensor, exchange: bool = True) -> StepStatistics:
        """Make one optimiser step, and return its statistics, which `statistics` averages; nothing waits for the host.

        rows: samples (batch, columns of `packer.layout`); exchange: whether to average over all ranks.
        """
        flat, packer, cfg = self.flat, self.packer, self.cfg
        value_loss = self._critic_gradient(rows, packer.layout, flat.critic, cfg, flat.critic_gradient)
        losses = self._actor_gradient(
            rows, packer.layout, flat.actor, packer.old_log_std, self._entropy_coef, cfg, flat.actor_gradient
        )
        flat.kl.copy_(losses.kl)
        if exchange:
            all_reduce_mean(flat.all_reduced)  # gradient and divergence
        return self._optimiser_step(
            self.optimiser.vectors, flat.actor_size, flat.kl, self._desired_kl, cfg, losses, value_loss, self._sums
        )

    def set_progress(self, progress: float) -> None:
        """Tell how much of the training is over, from 0 to 1; does not wait for the device."""
        cfg, late = self.cfg, min(max(2.0 * progress - 1.0, 0.0), 1.0)
        self._desired_kl.fill_((1.0 - late) * cfg.desired_kl + late * min(cfg.final_kl, cfg.desired_kl))
        final = cfg.entropy_coef if cfg.final_entropy is None else cfg.final_entropy
        self._entropy_coef.fill_((1.0 - late) * cfg.entropy_coef + late * final)

    def statistics(self) -> dict[str, float]:
        """Return averages since the last call, of losses and of finished episodes; waits for the device."""
        return take_averages(STATISTICS, self._sums, self.collector.finished, self.lr, self.model.log_std)

    def state_dict(self) -> dict[str, Any]:
        """Return networks, statistics and optimiser, tensors only."""
        model = self.model.state_dict()
        return {
            "model": {name: value.clone(memory_format=torch.contiguous_format) for name, value in model.items()},
            "optimiser": self.optimiser.state_dict(),
            "lr": self.lr,
            "episode": self.collector.episode,
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Take up what `state_dict` gave.

        Raises ValueError: a part is missing, unknown, of another shape or type, or not finite; nothing is changed.
        """
        self._check(state)
        self.model.load_state_dict(state["model"])
        self.optimiser.load_state_dict(state["optimiser"])
        self.lr.copy_(state["lr"])
        self.collector.episode.copy_(state["episode"])

    def _check(self, state: Any) -> None:
        """Raise InputError unless `load_state_dict` can take up a state: finite parts of the right shapes and types."""
        check_parts(state, ("model", "optimiser", "lr", "episode"), "ppo")
        model = self.model.state_dict()
        check_parts(state["model"], model, "ppo.model")
        for name, like in model.items():
            found, where = state["model"][name], f"ppo.model.{name}"
            check_tensor(found, like, where)
            if name.startswith("mirror_") and not torch.equal(found, like.to(found.device)):
                raise InputError(f"{where} is of another observation or action")
            check_values(found, where, 0.0 if name.endswith((".var", ".count")) else -math.inf)
        check_parts(state["optimiser"], range(len(self.flat.params)), "ppo.optimiser")
        for index, param in enumerate(self.flat.params):
            found, where = state["optimiser"][index], f"ppo.optimiser.{index}"
            check_parts(found, ("step", "exp_avg", "exp_avg_sq"), where)
            moments = (("step", self.lr, 0.0), ("exp_avg", param, -math.inf), ("exp_avg_sq", param, 0.0))
            for name, like, least in moments:
                check_tensor(found[name], like, f"{where}.{name}")
                check_values(found[name], f"{where}.{name}", least)
        check_tensor(state["lr"], self.lr, "ppo.lr")
        check_values(state["lr"], "ppo.lr", 0.0)
        check_tensor(state["episode"], self.collector.episode, "ppo.episode", (torch.float32,))  # of earlier versions
        check_values(state["episode"], "ppo.episode")

    def close(self) -> None:
        """Drop all graphs; needed before the group of processes ends."""
        for graph in (self._roll, self._batch, self._optimise):
            graph.close()


def critic_gradient(
    rows: torch.Tensor, layout: RowLayout, critic: Layers, cfg: PpoCfg, out: torch.Tensor
) -> torch.Tensor:
    """Write the gradient of the weighted value loss to `out`, and return the loss before weighting.

    The squared error, or with `clip_value` the larger of it and that of the value kept within `clip` of the old one.

    rows: (batch, columns) as `layout`; out: the vector's part of the critic.
    """
    batch, dtype = layout.split(rows), DTYPES[cfg.precision]
    head, seen = critic.forward(layout.critic_features(rows), dtype)
    change = head.squeeze(-1) - batch.value
    error = head.squeeze(-1) - batch.target
    loss, slope = error.square(), error
    if cfg.clip_value:
        near = batch.value + change.clamp(-cfg.clip, cfg.clip) - batch.target
        slope = torch.where(near.square() > loss, near * (change.abs() <= cfg.clip), error)
        loss = torch.maximum(loss, near.square())
    slope = slope * (2.0 * cfg.value_coef / rows.shape[0])
    out.copy_(joined(critic.backward(seen, slope[:, None], dtype)))
    return loss.mean()


def actor_gradient(
    rows: torch.Tensor, layout: RowLayout, actor: Actor, old_log_std: torch.Tensor, entropy_coef: torch.Tensor,
    cfg: PpoCfg, out: torch.Tensor,
) -> ActorLosses:  # fmt: skip
    """Write the gradient of surrogate and entropy bonus to `out`.

    The clipped surrogate of Schulman et al. 2017, eq. 7, as a loss: -E[min(r A, clip(r) A)] with r = π(a) / π_old(a).
    Where r A is the smaller, ∂/∂log π = -r A / batch, else 0.

    rows: (batch, columns) as `layout`; entropy_coef: (); out: the vector's part of actor and noise.
    """
    batch, dtype, log_std = layout.split(rows), DTYPES[cfg.precision], actor.log_std
    mean, difference, seen = actor.forward(layout.features(rows), dtype)
    ratio = torch.exp(gaussian_log_prob(batch.action, mean, log_std) - batch.log_prob)
    gain = batch.advantage * ratio
    clipped = batch.advantage * ratio.clamp(1.0 - cfg.clip, 1.0 + cfg.clip)
    slope = torch.where(gain > clipped, 0.0, gain)[:, None] / -rows.shape[0]
    deviation = (batch.action - mean) * torch.exp(-log_std)
    noise = (slope * (deviation.square() - 1.0)).sum(0) - entropy_coef
    gradients = actor.backward(seen, slope * deviation * torch.exp(-log_std), dtype)
    out.copy_(joined([*gradients, noise]))
    entropy = (log_std + 0.5 * math.log(2.0 * math.pi * math.e)).sum()
    kl = gaussian_kl(batch.mean, old_log_std, mean, log_std).mean()
    return ActorLosses(-torch.minimum(gain, clipped).mean(), entropy, difference.square().mean(), kl)


def optimiser_step(
    vectors: AdamVectors, actor_size: int, kl: torch.Tensor, desired_kl: torch.Tensor, cfg: PpoCfg, losses: ActorLosses,
    value_loss: torch.Tensor, sums: torch.Tensor,
) -> StepStatistics:  # fmt: skip
    """Adapt the step size to the divergence kl (), clip the gradient, make a step of Adam, and count the step.

    A non-finite gradient counts as none. sums: (len(STATISTICS) + 1,) of the statistics of all steps, and their number.
    """
    vectors.lr.copy_(adapted_lr(vectors.lr, kl, cfg, desired_kl))
    norms = clip_gradient(vectors.gradient, actor_size, cfg.max_grad_norm)
    adam_step(vectors)
    skipped = 1.0 - norms.isfinite().all().float()
    surrogate, entropy, asymmetry, _ = losses
    step = StepStatistics(surrogate, value_loss, entropy, asymmetry, kl.clone(), norms[0], norms[1], skipped)
    sums.add_(torch.nan_to_num(torch.stack([*step, torch.ones_like(kl)]), nan=0.0, posinf=0.0, neginf=0.0))
    return step


def take_averages(
    names: Sequence[str], sums: torch.Tensor, finished: torch.Tensor, lr: torch.Tensor, log_std: torch.Tensor
) -> dict[str, float]:
    """Return averages to log since the last call, and set their sums to zero; waits for the device.

    sums: (len(names) + 1,) of losses, and the number of steps; finished: (3, ...) as `Collector.finished`; lr: ();
    log_std: (num_actions,).
    """
    (*totals, count), ended = sums.tolist(), finished.view(3, -1).sum(1).tolist()
    result = {f"Loss/{name}": total / max(count, 1.0) for name, total in zip(names, totals, strict=True)}
    result |= {"Loss/learning_rate": lr.item(), "Policy/mean_std": log_std.exp().mean().item()}
    if ended[2] > 0.0:
        result |= {"Train/mean_return": ended[0] / ended[2], "Train/mean_length": ended[1] / ended[2]}
    sums.zero_()
    finished.zero_()
    return result
