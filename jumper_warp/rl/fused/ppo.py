"""PPO trainer whose rollout and update run in fused Triton kernels."""

from __future__ import annotations

import torch

from jumper_warp.envs.vec_env import VecEnv
from jumper_warp.rl.cfg import PpoCfg
from jumper_warp.rl.distributed import world_size
from jumper_warp.rl.fused.collector import FusedCollector
from jumper_warp.rl.fused.networks import FusedModel
from jumper_warp.rl.fused.update import FusedUpdate
from jumper_warp.rl.learner import Learner
from jumper_warp.rl.samples import Batch
from jumper_warp.utils.errors import InputError


class FusedPpo(Learner):
    """PPO learner that acts and updates with fused Triton kernels."""

    collector: FusedCollector

    def __init__(self, env: VecEnv, cfg: PpoCfg) -> None:
        """Build networks and buffers, with the same weights as `Ppo` for a seed; arguments and errors as `Learner`."""
        super().__init__(env, cfg)
        dtype = torch.bfloat16 if env.device.type == "cuda" else torch.float32
        rows = max(self.batch_size // cfg.minibatches, env.num_envs)
        self.networks = FusedModel(self.model, self.flat, rows, dtype)
        self.collector = FusedCollector(env, cfg, self.model, self.networks)
        self.rollout = self.collector.rollout
        self.fused = FusedUpdate(
            self.collector, cfg, self.model, self.optimiser, self.networks, (self._desired_kl, self._entropy_coef),
            self._sums,
        )  # fmt: skip
        self._capture(epochs=world_size() == 1)

    def compile(self) -> None:
        """Compile the kernels by running them once; parameters, optimiser and counts are restored afterwards.

        Raises InputError: Triton cannot compile them.
        """
        modified = [*self.optimiser.tensors, self._sums, self.collector.episode, self.collector.finished]
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
        """See `Learner.batch`; the orders are sampled beside the other work on a GPU."""
        self.fused.side_by_side(self._sample_orders, self.fused.pack)
        return self.fused.batch()

    def optimise(self, samples: torch.Tensor) -> None:
        """See `Learner.optimise`."""
        self.fused.step(samples)

    def close(self) -> None:
        """Delete all CUDA graphs; required before the process group is destroyed."""
        super().close()
        self.fused.close()
