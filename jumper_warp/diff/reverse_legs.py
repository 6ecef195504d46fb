"""Reverse pass of a differentiable rollout with one thread per leg.

Four launches for every `SPAN` saved rows of the trajectory, from the last rows to the first: recompute the steps,
reverse them, and add the gradients w.r.t. constants of legs and of motors. Few rows at a time bound the memory.
"""

from __future__ import annotations

import warp as wp

from jumper_warp.sim.dynamics import JumperDynamics
from jumper_warp.utils.kernels import Kernel, KernelStruct

SPAN = 4  # rows that one set of launches reverses


class LegThreadReverse:
    """Launcher of the kernels that backpropagate through a rollout with a thread per leg.

    The kernels are `rollout_legs_adjoint` and `constants_adjoint` in `jumper_warp.kernels.dynamics`.
    """

    def __init__(self, dynamics: JumperDynamics, every: int):
        """Allocate the record of `SPAN` rows of the trajectory that the reverse kernels recompute.

        every: physics steps between rows of a trajectory.
        """
        self._dynamics = dynamics
        self._modules = dynamics.modules
        self._device = dynamics.model.device
        self._num = dynamics.model.world_count
        module = self._modules.leg_record
        shape = {"dtype": dynamics.real, "device": self._device}
        self._record = module.LegRecord()
        entries = SPAN * (every + 1)
        self._record.base = wp.zeros((entries, int(module.BASE_FIELDS), self._num), **shape)
        self._record.legs = wp.zeros((entries, int(module.LEG_FIELDS), self._num, 4), **shape)

    def run(self, settings: KernelStruct, motion: list, cotangents: KernelStruct, gradients: KernelStruct) -> None:
        """Backpropagate through a rollout, and add the gradients w.r.t. its inputs to `gradients`.

        `gradients`: `Gradients`; its q and qd must hold the last row's cotangents. All arguments are structs of the
        kernels. settings: `StepSettings`. motion: [`Timing`, `Actuation`, `Commands`, filtered targets (T, 12,
        num_worlds), `TrajectoryArrays`] of the rollout. cotangents: `TrajectoryArrays`, the gradient of the loss w.r.t.
        the rollout's.
        """
        robot = self._dynamics.robot
        record = self._record
        num = self._num
        legs = self._modules.rollout_legs_adjoint
        constants = self._modules.constants_adjoint
        timing, *actuated, rows = motion
        turns = 8 if self._device.is_cuda else 1  # a GPU warp holds eight worlds, or eight steps of one world
        threads = -(-num // 8) * 8

        def launch(kernel: Kernel, dim: tuple[int, ...], *inputs: object) -> None:  # over dim and the four legs
            """Launch a kernel over `dim` and the four legs, in blocks of whole warps."""
            wp.launch(kernel, dim=(*dim, 4), inputs=list(inputs), device=self._device, block_dim=4 * turns)

        for end in range(timing.steps * timing.substeps // timing.every, 0, -SPAN):
            span = legs.Span()
            span.begin, span.end = max(0, end - SPAN), end
            launch(legs.replay_legs_kernel, (end - span.begin, threads), num, robot, settings, *motion, span, record)
            launch(
                legs.reverse_legs_kernel, (threads,), num, robot, settings, *motion, cotangents, span, record, gradients
            )
            launch(
                constants.leg_constants_kernel, (num, turns),
                turns, robot, settings, timing, rows, cotangents, span, record, gradients,
            )  # fmt: skip
            launch(
                constants.motor_constants_kernel, (num, turns),
                turns, settings, timing, *actuated, cotangents, span, record, gradients,
            )  # fmt: skip
