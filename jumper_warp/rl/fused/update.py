"""PPO's update with the fused kernels: bfloat16 products with float32 sums, actor and critic side by side."""

from __future__ import annotations

from collections.abc import Callable

import torch

from jumper_warp.rl.cfg import PpoCfg
from jumper_warp.rl.distributed import all_reduce_mean, world_size
from jumper_warp.rl.flat import FlatAdam
from jumper_warp.rl.fused.collector import FusedCollector
from jumper_warp.rl.fused.kernels.losses import actor_loss, critic_loss
from jumper_warp.rl.fused.kernels.optimiser import adam_step, prepare_step, sum_partials
from jumper_warp.rl.fused.networks import FusedModel, blocks, compile_side_by_side, launch, rows_per_split
from jumper_warp.rl.graphs import CapturedProcedure
from jumper_warp.rl.networks import ActorCritic, Moments
from jumper_warp.rl.samples import Batch, RolloutMoments, gae, update_statistics

SUM_BLOCK = 256  # Entries of the flat gradient in a block of the kernels that sum it
ADAM_BLOCK = 1024  # Entries of the flat vector in a block of Adam's kernel
LOSS_ROWS = 256  # Samples that a block of the losses' kernels handles at a time


class FusedUpdate:
    """PPO's update of actor and critic on the rollout of a `FusedCollector`, with gradients by fused kernels."""

    def __init__(
        self, collector: FusedCollector, cfg: PpoCfg, model: ActorCritic, optimiser: FlatAdam, fused: FusedModel,
        coefficients: tuple[torch.Tensor, torch.Tensor], sums: torch.Tensor,
    ) -> None:  # fmt: skip
        """Allocate the memory of the update; fused: networks of `model`, with the rows of a minibatch at least.

        With many ranks gradient and update are separate graphs, between which the gradients are averaged. coefficients:
        desired KL and weight of the entropy bonus, () each; sums: of the statistics, as in `Ppo`.
        """
        self._collector, self._cfg, self._model = collector, cfg, model
        self._optimiser, self._flat, self._fused, self._sums = optimiser, optimiser.flat, fused, sums
        self._desired_kl, self._entropy_coef = coefficients
        rollout, device = collector.rollout, self._flat.value.device
        self._rows = rollout.reward.numel() // cfg.minibatches
        self._features, self._critic_features = rollout.features.flatten(0, 1), collector.critic_inputs
        self._samples = rollout.samples.flatten(0, 1)
        self._head = torch.zeros(len(self._critic_features), device=device)  # the critic's outputs
        self._factors = torch.zeros(2, device=device)  # of Adam's moments
        self._squares = torch.zeros(blocks(self._flat.size, SUM_BLOCK), 2, device=device)
        self._side_stream = torch.cuda.Stream(device) if device.type == "cuda" else None
        self._index = torch.zeros(self._rows, dtype=torch.int64, device=device)  # samples, for the graphs of many ranks
        capture = self._side_stream is not None and cfg.graphs and world_size() > 1
        self._captured = (
            CapturedProcedure(lambda: self.compute_gradient(self._index), capture),
            CapturedProcedure(self.update_parameters, capture),
        )

    @torch.no_grad()
    def pack(self) -> None:
        """Compute values, advantages and returns, store them with the rollout's samples, and update running moments."""
        rollout, model, cfg = self._collector.rollout, self._model, self._cfg
        (steps, worlds), actions = rollout.reward.shape, rollout.action.shape[2]
        for start in range(0, len(self._head), self._rows):
            head = self._head[start : start + self._rows]
            output = self._fused.critic.forward(self._critic_features[start:], len(head))
            head.copy_(output[: len(head), 0])
        head, final_head = self._head.view(-1, worlds).split((steps + 1, steps))
        scaling = model.value_moments.scaling()
        reward = rollout.reward + cfg.gamma * rollout.timeout * scaling.denormalise(final_head)
        value = scaling.denormalise(head)
        advantage, target = (x.flatten() for x in gae(reward, rollout.done, value, cfg.gamma, cfg.lam))
        obs, critic_obs = self._collector.obs_writer.moments(), self._collector.critic_obs_writer.moments()
        local = RolloutMoments(Moments.from_samples(advantage), Moments.from_samples(target), obs, critic_obs)
        advantage_scaling = update_statistics(model, local, cfg)
        normalised = (advantage_scaling.normalise(advantage), model.value_moments.scaling().normalise(target))
        columns = (head[:-1].flatten(), *normalised)
        self._samples[:, 2 * actions + 1 : 2 * actions + 4] = torch.stack(columns, dim=1)

    def batch(self) -> Batch:
        """Return the rollout's samples, time-major, as views; observations have the type of matrix products."""
        collector, actions = self._collector, self._collector.rollout.action.shape[2]
        action, mean, *scalars = self._samples[:, : 2 * actions + 4].split((actions, actions, 1, 1, 1, 1), dim=1)
        sizes = collector.env.num_obs, len(self._model.critic_moments.mean)
        features = (self._features[:, : sizes[0]], self._critic_features[: len(self._samples), : sizes[1]])
        return Batch(*features, action, mean, *(each[:, 0] for each in scalars))

    def step(self, samples: torch.Tensor) -> None:
        """Run one optimiser step on samples, given by their indices (batch,), with the mean gradient of all ranks."""
        if world_size() == 1:
            self.compute_gradient(samples)
            self.update_parameters()
            return
        self._index.copy_(samples)
        gradient, update = self._captured
        gradient()
        all_reduce_mean(self._flat.all_reduced)
        update()

    def side_by_side(self, first: Callable[[], object], second: Callable[[], object]) -> None:
        """Run two independent procedures, at the same time on a GPU and one after the other on a CPU."""
        if self._side_stream is None:
            first()
            second()
            return
        stream = torch.cuda.current_stream()
        self._side_stream.wait_stream(stream)
        with torch.cuda.stream(self._side_stream):
            first()
        second()
        stream.wait_stream(self._side_stream)

    def compute_gradient(self, samples: torch.Tensor) -> None:
        """Write losses and gradient of a minibatch to `FlatParameters.all_reduced`; samples: indices (batch,).

        The kernels leave partial sums, each of some of the samples; they are added in a fixed order, which repeats
        bitwise.
        """
        self.side_by_side(lambda: self._critic_gradient(samples), lambda: self._actor_gradient(samples))
        fused, gradient = self._fused, self._flat.all_reduced
        launch(sum_partials, (blocks(len(gradient), SUM_BLOCK),))(
            fused.partial, fused.layout.table, gradient, fused.partial.stride(0), len(gradient), fused.splits,
            fused.images, SUM_BLOCK,
        )  # fmt: skip

    def _actor_gradient(self, samples: torch.Tensor) -> None:
        """Compute PPO's gradients of actor and noise; write them and the actor's losses as partial sums."""
        fused, rows = self._fused, len(samples)
        partial, layout, log_std = fused.partial, fused.layout, self._model.log_std
        output = fused.actor.forward(self._features, rows, samples)
        launch(actor_loss, (fused.splits,), num_warps=8)(
            output, fused.mirror, self._samples, self._samples.shape[1], samples, log_std,
            self._collector.rollout.log_std, self._entropy_coef, fused.actor.grad_output, partial[0, layout.noise :],
            partial[0, layout.losses :], partial.stride(0), rows, rows_per_split(rows, fused.splits), len(log_std),
            self._cfg.clip, fused.images, fused.actor.width, LOSS_ROWS,
        )  # fmt: skip
        fused.actor.backward(self._features, rows, samples)

    def _critic_gradient(self, samples: torch.Tensor) -> None:
        """Compute the critic's gradient of the value loss; write it and the loss as partial sums."""
        fused, cfg, rows = self._fused, self._cfg, len(samples)
        partial, critic = fused.partial, fused.critic
        output = critic.forward(self._critic_features, rows, samples)
        launch(critic_loss, (fused.splits,), num_warps=8)(
            output, self._samples, self._samples.shape[1], samples, critic.grad_output,
            partial[0, fused.layout.losses :], partial.stride(0), rows, rows_per_split(rows, fused.splits),
            len(self._model.log_std), cfg.clip, cfg.value_coef, cfg.clip_value, critic.width, LOSS_ROWS,
        )  # fmt: skip
        critic.backward(self._critic_features, rows, samples)

    def update_parameters(self) -> None:
        """Adapt the learning rate, clip the gradient, and run a step of Adam."""
        flat, cfg, adam, squares = self._flat, self._cfg, self._optimiser, self._squares
        launch(prepare_step, (len(squares),))(
            flat.all_reduced, squares, adam.lr, adam.step_count, self._factors, self._desired_kl, flat.size,
            flat.actor_size, cfg.min_lr, cfg.max_lr, cfg.desired_kl > 0.0, SUM_BLOCK,
        )  # fmt: skip
        launch(adam_step, (blocks(flat.size, ADAM_BLOCK),))(
            flat.value, flat.all_reduced, adam.exp_avg, adam.exp_avg_sq, squares, self._factors,
            self._fused.weights, self._fused.layout.table, self._sums, flat.size, flat.actor_size, cfg.max_grad_norm,
            1 << (len(squares) - 1).bit_length(), len(squares), self._fused.images, ADAM_BLOCK,
        )  # fmt: skip

    @torch.no_grad()
    def warm_up(self) -> None:
        """Compile all kernels and run them once; changes parameters, optimiser, rollout, counts and statistics."""
        if self._side_stream is not None:
            compile_side_by_side(self._launch_all, self._flat.value.device)
        self._launch_all()

    def _launch_all(self) -> None:
        """Launch every kernel of rollout and update once."""
        self._collector.act(0)
        self._collector.record(0)
        self._fused.critic.forward(self._critic_features, self._rows)
        self.compute_gradient(self._index)
        self.update_parameters()

    def close(self) -> None:
        """Delete the CUDA graphs."""
        for graph in self._captured:
            graph.close()
