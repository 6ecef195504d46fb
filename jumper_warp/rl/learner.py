"""What the two PPO learners share: networks, optimiser, schedules, statistics and saved state.

An iteration is `collect`, then `update`: CUDA graphs on a GPU, eager on a CPU. There is no host synchronisation within
an iteration. The learner in `jumper_warp.rl.torch` calls PyTorch, that in `jumper_warp.rl.fused` Triton kernels.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple, Protocol

import torch

from jumper_warp.envs.vec_env import VecEnv
from jumper_warp.rl.cfg import PpoCfg
from jumper_warp.rl.distributed import all_reduce_mean
from jumper_warp.rl.flat import FlatAdam, FlatParameters
from jumper_warp.rl.graphs import CapturedProcedure
from jumper_warp.rl.mirror import symmetries_of
from jumper_warp.rl.networks import ActorCritic
from jumper_warp.rl.samples import Batch
from jumper_warp.utils.allocator import keep_freed_memory
from jumper_warp.utils.errors import InputError


class StepStatistics(NamedTuple):
    """Losses, KL divergence and gradient norms at the start of an optimiser step, each () (see `rl.torch.ppo`)."""

    surrogate: torch.Tensor
    value: torch.Tensor  # value loss before weighting [variances of the return]
    entropy: torch.Tensor
    kl: torch.Tensor  # KL(old ‖ new) [nat], over all ranks
    gradient_actor: torch.Tensor  # norm of the actor's gradient before clipping, averaged over all ranks
    gradient_critic: torch.Tensor  # norm of the critic's gradient, likewise
    skipped: torch.Tensor  # 1 if a gradient was not finite and was replaced by 0


STATISTICS = StepStatistics._fields  # Names of the statistics that `Learner.statistics` averages over minibatches


class Rollouts(Protocol):
    """Collector of rollouts, as a learner uses it."""

    episode: torch.Tensor  # (2, num_envs) return and length of each world's current episode
    finished: torch.Tensor  # (3, num_envs) sums of returns and lengths, and number, of the finished episodes

    def roll(self, generator: torch.Generator | None = None) -> None:
        """Run the current policy for `PpoCfg.num_steps` policy steps, and record all transitions.

        generator: of the exploration noise (default: torch's).
        """


class Learner(ABC):
    """PPO trainer: `collect` fills the rollout, `update` trains actor and critic on it, `iterate` does both."""

    collector: Rollouts

    def __init__(self, env: VecEnv, cfg: PpoCfg) -> None:
        """Build actor, critic and optimiser on the environment's device; weights follow torch's CPU seed.

        Raises InputError as `PpoCfg.batch_size`, and as `symmetries_of` if symmetry is requested.
        """
        self.batch_size = cfg.batch_size(env.num_envs)
        self.env, self.cfg = env, cfg
        if env.device.type == "cuda":
            torch.set_float32_matmul_precision("high" if cfg.tf32 else "highest")
        else:
            keep_freed_memory()
        num_critic_obs = env.num_critic_obs if cfg.asymmetric_critic else env.num_obs
        symmetries = symmetries_of(env, cfg.symmetry)
        self.model = ActorCritic(
            env.num_obs, env.num_actions, cfg.hidden, cfg.activation, cfg.init_std, num_critic_obs, symmetries,
        ).to(env.device)  # fmt: skip
        self.flat = FlatParameters(self.model)
        self.optimiser = FlatAdam(self.flat, cfg.lr)
        self.lr = self.optimiser.lr
        self._desired_kl = torch.full((), cfg.desired_kl, device=env.device)
        self._entropy_coef = torch.full((), cfg.entropy_coef, device=env.device)
        self.generator = torch.Generator(env.device).manual_seed(torch.initial_seed())
        """Random generator of actions and of the samples' order; it starts with torch's seed."""
        self._orders = torch.zeros(cfg.epochs, self.batch_size, dtype=torch.int64, device=env.device)
        counts = {"dtype": torch.float64, "device": env.device}  # float32 counts to 2^24 only
        self._sums = torch.zeros(len(STATISTICS) + 1, **counts)  # sums of the statistics, and the number of steps

    def _capture(self, *, epochs: bool = True) -> None:
        """Prepare the parts of an iteration, as CUDA graphs where the settings ask for them; epochs: the update too."""
        graphs = self.env.device.type == "cuda" and self.cfg.graphs
        self._roll_graph = CapturedProcedure(partial(self.collector.roll, self.generator), graphs, self.generator)
        self._batch_graph = CapturedProcedure(self.batch, graphs, self.generator)
        self._epochs_graph = CapturedProcedure(self._run_epochs, graphs and epochs)

    @abstractmethod
    def batch(self) -> Batch:
        """Compute the rollout's training samples, return views of them, time-major, and update the running moments.

        Also samples the order of the samples in every epoch.
        """

    @abstractmethod
    def optimise(self, samples: torch.Tensor) -> object:
        """Run one optimiser step on a minibatch, without host synchronisation; samples: indices (n,) int64."""

    def compile(self) -> None:  # noqa: B027 an optional step
        """Compile what the learner's iterations need, by default nothing."""

    @torch.no_grad()
    def _run_epochs(self) -> None:
        """Run one optimiser step per minibatch for all epochs."""
        for order in self._orders:
            for samples in order.chunk(self.cfg.minibatches):
                self.optimise(samples)

    def _sample_orders(self) -> None:
        """Sample the random order of the training samples in every epoch."""
        for order in self._orders:
            order.copy_(self.order())

    def iterate(self, mark: Callable[[], None] = lambda: None) -> None:
        """Collect a rollout, and update the networks on it; call `mark` after launching each of the two."""
        self.collect()
        mark()
        self.update()
        mark()

    def collect(self) -> None:
        """Run the current policy in the environment for one rollout, and store all transitions in `rollout`."""
        self._roll_graph()

    def update(self) -> None:
        """Optimise the networks on the rollout for all epochs."""
        self._batch_graph()
        self._epochs_graph()

    def order(self) -> torch.Tensor:
        """Return a random permutation of the batch's samples, (batch_size,) int64."""
        return torch.rand(self.batch_size, device=self.env.device, generator=self.generator).argsort()

    def set_progress(self, progress: float) -> None:
        """Set the desired KL divergence and the entropy coefficient for the training's progress (0: start, 1: end).

        Both are constant in the first half, and interpolated linearly to their final values in the second half. Does
        not synchronise with the device.
        """
        cfg, decay = self.cfg, min(max(2.0 * progress - 1.0, 0.0), 1.0)
        self._desired_kl.fill_((1.0 - decay) * cfg.desired_kl + decay * min(cfg.final_desired_kl, cfg.desired_kl))
        all_reduce_mean(self._desired_kl)  # all processes adapt the learning rate alike, although their clocks differ
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

    def is_finite(self) -> bool:
        """Return whether all weights and observation statistics are finite (waits for the device)."""
        parts = (self.flat.value, *(buffer for buffer in self.model.buffers() if buffer.is_floating_point()))
        return bool(torch.stack([part.isfinite().all() for part in parts]).all())

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

        The rate is limited to `min_lr` and `max_lr`. Raises InputError: saved with another symmetry; and LookupError or
        RuntimeError: a part is missing, unknown or of another shape.
        """
        mirrors = {name: own for name, own in self.model.state_dict().items() if name.startswith("mirror_")}
        for name, own in mirrors.items():
            saved = torch.atleast_2d(state["model"][name])  # in earlier versions (n,)
            if not torch.equal(saved, own.to(saved.device)):
                raise InputError(f"{name} is for another observation, action or symmetry")
        self.model.load_state_dict(state["model"] | mirrors)
        self.optimiser.load_state_dict(state["optimiser"])
        self.lr.copy_(state["lr"]).clamp_(self.cfg.min_lr, self.cfg.max_lr)
        self.collector.episode.copy_(state["episode"])

    def random_state(self) -> dict[str, torch.Tensor]:
        """Return the states of torch's default random generators, `cpu` and `cuda`, and of the learner's.

        The learner's is `learner_cpu` or `learner_cuda`, by its device.
        """
        state = {"cpu": torch.get_rng_state(), f"learner_{self.generator.device.type}": self.generator.get_state()}
        return state | ({"cuda": torch.cuda.get_rng_state()} if torch.cuda.is_available() else {})

    def set_random_state(self, state: dict[str, torch.Tensor]) -> None:
        """Restore the result of `random_state`, apart from generators of another kind of device."""
        torch.set_rng_state(state["cpu"])
        if "cuda" in state and torch.cuda.is_available():
            torch.cuda.set_rng_state(state["cuda"])
        if (own := state.get(f"learner_{self.generator.device.type}")) is not None:
            self.generator.set_state(own)

    def close(self) -> None:
        """Delete all CUDA graphs; required before the process group is destroyed."""
        for graph in (self._roll_graph, self._batch_graph, self._epochs_graph):
            graph.close()
