"""PPO trainer whose rollout and update run in fused Triton kernels."""

from __future__ import annotations

from typing import TYPE_CHECKING, cast

import torch

from jumper_warp.envs.vec_env import VecEnv
from jumper_warp.rl.cfg import PpoCfg
from jumper_warp.rl.distributed import world_size
from jumper_warp.rl.fused.collector import FusedCollector
from jumper_warp.rl.fused.networks import FusedModel
from jumper_warp.rl.fused.update import FusedUpdate
from jumper_warp.rl.graphs import CapturedProcedure
from jumper_warp.rl.ppo import Ppo
from jumper_warp.rl.samples import Batch
from jumper_warp.utils.errors import InputError

if TYPE_CHECKING:
    from jumper_warp.rl.rollout import Collector, RolloutBuffer


class FusedPpo(Ppo):
    """PPO trainer that acts and updates with fused kernels; it has no `packer`, and its rollout is a `FusedRollout`."""

    def __init__(self, env: VecEnv, cfg: PpoCfg) -> None:
        """Build networks and buffers as `Ppo` does, with the same weights for a seed. Raises InputError as `Ppo`."""
        super().__init__(env, cfg)
        del self.collector, self.rollout, self.packer, self._minibatch, self._roll, self._batch, self._optimise
        model, cuda = self.model, env.device.type == "cuda"
        rows = max(self.batch_size // cfg.minibatches, env.num_envs)
        self.networks = networks = FusedModel(model, self.flat, rows, torch.bfloat16 if cuda else torch.float32)
        collector = FusedCollector(env, cfg, model, self.flat, networks)
        self.collector, self.rollout = cast("Collector", collector), cast("RolloutBuffer", collector.rollout)
        coefficients, obs_mirror = (self._desired_kl, self._entropy_coef), model.symmetry and model.symmetry.obs
        self.fused = FusedUpdate(
            collector, cfg, model, self.optimiser, networks, coefficients, self._sums, obs_mirror
        )  # fmt: skip
        capture = cuda and cfg.graphs
        self._roll = CapturedProcedure(collector.roll, capture)
        self._batch = CapturedProcedure(self.batch, capture)
        self._optimise = CapturedProcedure(self._run_epochs, capture and world_size() == 1)

    def compile(self) -> None:
        """Compile the kernels by running them once; parameters, optimiser and counts are restored afterwards.

        Raises InputError: Triton cannot compile them.
        """
        modified = [*self.optimiser.vectors, self._sums, self.collector.episode, self.collector.finished]
        originals = [tensor.clone() for tensor in modified]
        try:
            self.fused.warm_up()
        except Exception as error:  # compilers raise many types
            reason = f"{type(error).__name__} {error}"[:240]
            raise InputError(f"the fused kernels do not work here, pass --ppo.no-fused: {reason}") from error
        for tensor, original in zip(modified, originals, strict=True):
            tensor.copy_(original)

    @torch.no_grad()
    def batch(self) -> Batch:
        """Compute the rollout's training samples, return views of them, time-major, and update the running moments.

        Also samples the order of the samples in every epoch.
        """
        self.fused.side_by_side(self._sample_orders, self.fused.pack)
        return self.fused.batch()

    def _sample_orders(self) -> None:
        """Sample the random order of the training samples in every epoch."""
        for order in self._orders:
            order.copy_(self.order())

    @torch.no_grad()
    def _run_epochs(self) -> None:
        """Run one optimiser step per minibatch for all epochs."""
        for order in self._orders:
            for samples in order.chunk(self.cfg.minibatches):
                self.fused.step(samples)

    def close(self) -> None:
        """Delete all CUDA graphs; required before the process group is destroyed."""
        super().close()
        self.fused.close()
