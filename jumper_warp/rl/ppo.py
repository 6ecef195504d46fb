"""Proximal policy optimisation. One iteration is `collect` and then `update`: CUDA graphs on a GPU, eager on a CPU.

Nothing between the first action and the last optimiser step waits for the host. Schulman et al. 2017 for the surrogate,
2016 for the advantage; observations, returns and advantages are normalised, the step size follows the KL divergence.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import torch

from jumper_warp.envs.vec_env import VecEnv
from jumper_warp.rl.adam import AdamVectors, FlatAdam, descend
from jumper_warp.rl.cfg import PpoCfg
from jumper_warp.rl.compiling import Compiler
from jumper_warp.rl.distributed import average_over_ranks
from jumper_warp.rl.flat import FlatParameters
from jumper_warp.rl.graphs import Captured
from jumper_warp.rl.losses import actor_gradient, critic_gradient
from jumper_warp.rl.mirror import symmetry_of
from jumper_warp.rl.networks import ActorCritic
from jumper_warp.rl.rollout import Collector
from jumper_warp.rl.samples import Batch, Sampler
from jumper_warp.utils.allocator import keep_freed_memory
from jumper_warp.utils.errors import InputError
from jumper_warp.utils.state_checks import check_parts, check_tensor, check_values

STATISTICS = ("surrogate", "value", "entropy", "asymmetry", "kl", "gradient_actor", "gradient_critic", "skipped")
"""What `Ppo.statistics` averages over minibatches; skipped is the share of steps with a non-finite gradient,
asymmetry the mean square of f(x) - N f(M x), see `jumper_warp.rl.mirror`, 0 without symmetry."""


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
        self._parts = (self.flat.actor(self.flat.value), self.flat.critic(), self.flat.gradients())
        self._symmetry = symmetry and symmetry.padded(self._parts[0][0].weights[0].shape[1])
        self.optimiser = FlatAdam(self.flat, cfg.lr)
        self.lr = self.optimiser.lr
        self._desired_kl = torch.full((), cfg.desired_kl, device=env.device)
        self._entropy_coef = torch.full((), cfg.entropy_coef, device=env.device)
        self.compiler = compiler = Compiler(cfg.compile == "on" or (cfg.compile == "auto" and cuda))
        self.collector = Collector(env, cfg, self.model, self.flat, compiler)
        self.rollout = self.collector.rollout
        self.sampler = Sampler(self.rollout, cfg, self.model, self.flat, compiler, symmetry and symmetry.obs)
        self._minibatch = self.sampler.rows.new_zeros(self.batch_size // cfg.minibatches, self.sampler.rows.shape[1])
        self._orders = torch.zeros(cfg.epochs, self.batch_size, dtype=torch.int64, device=env.device)
        counts = {"dtype": torch.float64, "device": env.device}  # float32 counts to 2^24 only
        self._sums = torch.zeros(len(STATISTICS) + 1, **counts)  # and their number
        self._actor_gradient, self._critic_gradient = compiler(actor_gradient), compiler(critic_gradient)
        self._finish = compiler(_finish)
        procedures: tuple[Callable[[], object], ...] = (self.collector.roll, self.batch, self._learn)
        self._roll, self._batch, self._optimise = (Captured(each, cuda and cfg.graphs) for each in procedures)

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
        self.collector.rehearse()
        self.sampler.rehearse()
        self._step(self._differentiate(self._minibatch))
        for tensor, value in zip(changed, before, strict=True):
            tensor.copy_(value)

    @torch.no_grad()
    def batch(self) -> Batch:
        """Return the rollout as samples, time-major, and take it into the running statistics; views of `sampler.rows`.

        Their orders for all epochs are drawn with them.
        """
        self.sampler.pack()
        for order in self._orders:
            order.copy_(self.order())
        return self.sampler.layout.split(self.sampler.rows)

    def order(self) -> torch.Tensor:
        """Return a random order of the batch's samples, (batch_size,)."""
        return torch.rand(self.batch_size, device=self.env.device).argsort()

    @torch.no_grad()
    def _learn(self) -> None:
        for order in self._orders:
            for samples in order.chunk(self.cfg.minibatches):
                torch.index_select(self.sampler.rows, 0, samples, out=self._minibatch)
                self._descend(self._minibatch)

    def _descend(self, rows: torch.Tensor) -> None:
        """Make one optimiser step with samples (batch, columns); a non-finite gradient counts as none."""
        found = self._differentiate(rows)
        average_over_ranks(self.flat.gradient)
        self._step(found)

    @torch.no_grad()
    def _differentiate(self, rows: torch.Tensor) -> tuple[torch.Tensor, ...]:
        """Fill the gradient; return surrogate, value loss, entropy and asymmetry."""
        (actor, log_std), critic, (to_actor, to_critic) = self._parts
        layout, cfg, old_log_std = self.sampler.layout, self.cfg, self.sampler.old_log_std
        value_loss = self._critic_gradient(rows, layout, critic, cfg, to_critic)
        found = self._actor_gradient(
            rows, layout, actor, log_std, old_log_std, self._entropy_coef, cfg, self._symmetry, to_actor
        )
        surrogate, entropy, asymmetry, kl = found
        self.flat.gradient[-1] = kl
        return surrogate, value_loss, entropy, asymmetry

    @torch.no_grad()
    def _step(self, found: tuple[torch.Tensor, ...]) -> None:
        """Descend along the gradient; found: as `_differentiate` returned it."""
        self._finish(self.optimiser.vectors, self.flat.actor_size, self._desired_kl, self.cfg, found, self._sums)

    def set_progress(self, progress: float) -> None:
        """Tell how much of the training is over, from 0 to 1; does not wait for the device."""
        cfg, late = self.cfg, min(max(2.0 * progress - 1.0, 0.0), 1.0)
        self._desired_kl.fill_((1.0 - late) * cfg.desired_kl + late * min(cfg.final_kl, cfg.desired_kl))
        final = cfg.entropy_coef if cfg.final_entropy is None else cfg.final_entropy
        self._entropy_coef.fill_((1.0 - late) * cfg.entropy_coef + late * final)

    def statistics(self) -> dict[str, float]:
        """Return averages since the last call, of losses and of finished episodes; waits for the device."""
        finished = self.collector.finished
        (*sums, count), ended = self._sums.tolist(), finished.sum(1).tolist()
        result = {f"Loss/{name}": total / max(count, 1.0) for name, total in zip(STATISTICS, sums, strict=True)}
        result["Loss/learning_rate"] = self.lr.item()
        result["Policy/mean_std"] = self.model.log_std.exp().mean().item()
        if ended[2] > 0.0:
            result["Train/mean_return"] = ended[0] / ended[2]
            result["Train/mean_length"] = ended[1] / ended[2]
        for total in (self._sums, finished):
            total.zero_()
        return result

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


def _finish(
    vectors: AdamVectors, actor_size: int, desired_kl: torch.Tensor, cfg: PpoCfg, found: tuple[torch.Tensor, ...],
    sums: torch.Tensor,
) -> None:  # fmt: skip
    """Make the optimiser step and count its figures; found: as `Ppo._differentiate` returned it."""
    kl, norms = descend(vectors, actor_size, desired_kl, cfg)
    skipped = 1.0 - norms.isfinite().all().float()
    terms = torch.stack([*found, kl, *norms, skipped, torch.ones_like(kl)])
    sums.add_(torch.nan_to_num(terms, nan=0.0, posinf=0.0, neginf=0.0))
