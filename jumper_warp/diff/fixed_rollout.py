"""Rollouts in arrays that are allocated once, for the many short passes of an optimisation in real time."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
import warp as wp

from jumper_warp.diff.reverse_legs import LegThreadReverse
from jumper_warp.diff.rollout import Rollout
from jumper_warp.utils.kernels import Kernel
from jumper_warp.utils.threads import locked, run_in_parallel


class FixedRollout(Rollout):
    """`Rollout` whose passes replace the arrays of the passes before; on a CPU their launches are recorded.

    Gradients are w.r.t. motor targets alone. Arguments are not checked. Call `allocate` before the first pass.

    Attributes (tensors that share memory with the kernels' arrays; the last pass defines the rows of its policy steps):
        q, qd, impulse: as in `Trajectory`.
        by_q, by_qd: gradient of the loss w.r.t. q and qd, to be written before `reverse`.
    """

    @locked
    def allocate(self, most: int) -> None:
        """Allocate arrays for passes of at most `most` policy steps."""
        modules = self.dynamics.modules
        n = self.num_worlds
        vec3 = modules.scalar.vec3
        commands = modules.trajectory.Commands()
        commands.target, commands.wrench = self._zeros(most, 12, n), self._zeros(most, 6, n)
        earlier = (self.targets_kept, 12)
        commands.initial_target, commands.impulse = self._zeros(*earlier, n), self._zeros(4, n, dtype=vec3)
        rows = self._rows(most)
        cotangents = modules.trajectory.TrajectoryArrays()
        cotangents.q, cotangents.qd = wp.zeros_like(rows.q), wp.zeros_like(rows.qd)
        for name, dtype in (("torque", self.real), ("impulse", vec3), ("pressed", wp.uint8)):
            setattr(cotangents, name, self._zeros(0, 0, 0, dtype=dtype))
        gradients = modules.gradients.Gradients()
        shapes = {"q": (19,), "qd": (18,), "target": (most, 12), "initial_target": earlier, "wrench": (most, 6),
                  "filtered_target": (most, 12), "parameters": (int(modules.gradients.GRADIENT_ROWS),)}  # fmt: skip
        for name, shape in shapes.items():
            setattr(gradients, name, self._zeros(*shape, n))
        self._sums = [wp.to_torch(getattr(gradients, name)) for name in ("initial_target", "wrench", "filtered_target")]
        self._ends = wp.to_torch(gradients.q), wp.to_torch(gradients.qd)
        self._by_target = wp.to_torch(gradients.target)
        self._commanded = wp.to_torch(commands.target), wp.to_torch(commands.initial_target)
        self.q, self.qd, self.impulse = (wp.to_torch(getattr(rows, name)) for name in ("q", "qd", "impulse"))
        self.by_q, self.by_qd = wp.to_torch(cotangents.q), wp.to_torch(cotangents.qd)
        filtered_target = self._zeros(most, 12, n)
        self._forward = [self._actuation, commands, self._drive], [filtered_target, rows]
        self._motion = [self._actuation, commands, filtered_target, rows]
        self._reverse = cotangents, gradients
        self._record = self.dynamics.step_record(self.every)
        self._recorded: dict[Kernel, list[Any]] = {}  # `wp.Launch`, one a slice of worlds
        self._timed = self._timing(most)
        self._legs = LegThreadReverse(self.dynamics, self.every) if self.by_legs else None

    @locked
    def forward(self, targets: np.ndarray, q: np.ndarray, qd: np.ndarray, initial_target: np.ndarray) -> int:
        """Simulate all worlds over the policy steps of targets, and return the number of rows; see `Rollout.run`."""
        count = len(targets)
        self._timed = self._timing(count)
        target, initial = self._commanded
        earlier = initial_target.reshape(-1, 12, self.num_worlds)[-len(initial) :]
        for into, values in ((target[:count], targets), (initial, earlier), (self.q[0], q), (self.qd[0], qd)):
            into.copy_(torch.from_numpy(values))
        modules = self.dynamics.modules
        inputs, outputs = self._forward
        if self.by_legs:
            self._launch_legs(modules.rollout_legs.rollout_legs_kernel, [self._timed, *inputs], outputs)
        else:
            self._launch(modules.rollout.rollout_kernel, [self._timed, *inputs], [self.dynamics.work, *outputs])
        return count * self.substeps // self.every + 1

    @locked
    def reverse(self) -> np.ndarray:
        """Return the gradient of the worlds' losses w.r.t. the targets of the last pass, (policy steps, 12, worlds).

        The rows of `by_q` and `by_qd` define the loss.
        """
        count = self._timed.steps
        for array in self._sums:
            array.zero_()
        cotangents, gradients = self._reverse
        motion = [self._timed, *self._motion]
        if self._legs is not None:
            for into, rows in zip(self._ends, (self.by_q, self.by_qd), strict=True):
                into.copy_(rows[count * self.substeps // self.every])
            self._legs.run(self.dynamics.settings(self.dt, 1), motion, cotangents, gradients)
        else:
            kernel = self.dynamics.modules.rollout_targets.reverse_targets_kernel
            self._launch(kernel, [*motion, cotangents], [self._record, gradients])
        return self._by_target[:count].cpu().numpy()

    def _launch(self, kernel: Kernel, inputs: list, outputs: list) -> None:
        """Launch a kernel on a CPU with the arguments of its first launch; only the first of `inputs` may change."""
        if kernel not in self._recorded:
            self._recorded[kernel] = [
                wp.launch(
                    kernel, dim=worlds.count, outputs=outputs, device=self.device, block_dim=1, record_cmd=True,
                    inputs=[self.dynamics.robot, self.dynamics.settings(self.dt, 1, worlds.first), *inputs],
                )
                for worlds in self.slices
            ]  # fmt: skip
        launches = self._recorded[kernel]
        for launch in launches:
            launch.set_param_at_index(2, inputs[0])
        run_in_parallel([launch.launch for launch in launches], len(launches))
