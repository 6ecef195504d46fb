"""One jump simulated by the solver's own kernel, and as a differentiable rollout, for timing."""

from __future__ import annotations

import numpy as np
import warp as wp

from jumper_warp.diff.rollout import Rollout, Trajectory, compact
from jumper_warp.kernels.layout import COORDS, DOFS
from jumper_warp.robot.model import PHYSICS_DT, build_model
from jumper_warp.robot.motors import filter_params, jumping_motors, vertical_jump_filter
from jumper_warp.sim.simulation import SUBSTEPS
from jumper_warp.sim.solver import MAX_SWEEPS, TOLERANCE
from support.gradients import PUSH, schedule, start


class PlainJump:
    """Jump without gradients, by the solver's kernel: a captured graph of filter and physics of all policy steps."""

    def __init__(self, rollout: Rollout, targets: np.ndarray):
        """Capture the jump's graph; model and parameters are those of the rollout.

        targets: motor targets [rad], (steps, 12).
        """
        self._rollout, n = rollout, rollout.num_worlds
        dynamics, modules = rollout.dynamics, rollout.dynamics.modules
        self._start = [rollout.array(np.tile(values, n)) for values in start()]
        self._q, self._qd = (wp.clone(array) for array in self._start)
        self._targets = rollout.array(np.repeat(targets[:, :, None], n, axis=2))
        filtered = rollout.array(np.zeros((12, n)))
        limits = filter_params(vertical_jump_filter(), module=modules.command_filter)
        wrench = wp.zeros(dynamics.model.body_count, dtype=wp.spatial_vectorf, device=rollout.device)
        motors = rollout.motors
        drive = dynamics.drive(rollout.array(np.zeros(DOFS * n)), wrench, motors, filtered)
        settings = dynamics.settings(PHYSICS_DT, SUBSTEPS, MAX_SWEEPS, TOLERANCE)

        def run() -> None:
            """Simulate the jump from its start: per target one command filter launch and SUBSTEPS physics steps."""
            dynamics.work.impulse.zero_()
            for current, initial in zip((self._q, self._qd), self._start, strict=True):
                wp.copy(current, initial)
            for target in (self._targets[step] for step in range(len(targets))):
                wp.launch(
                    modules.command_filter.command_filter_kernel, dim=(4, n), device=rollout.device,
                    inputs=[0, target, self._q, self._qd, COORDS, DOFS, motors.offset, limits], outputs=[filtered],
                )  # fmt: skip
                dynamics.advance(settings, drive, self._q, self._qd, self._q, self._qd)

        run()
        with wp.ScopedCapture(device=rollout.device) as capture:
            run()
        assert capture.graph is not None
        self._graph, self._arrays = capture.graph, (drive, filtered, wrench)  # a graph on a GPU keeps no arrays alive

    def run(self) -> None:
        """Simulate the jump by replaying the graph."""
        wp.capture_launch(self._graph)

    def heights(self) -> np.ndarray:
        """Return the final base heights [m], (num_worlds,)."""
        return self._q.numpy().reshape(self._rollout.num_worlds, -1)[:, 2]


class GradientRun:
    """Jump as a differentiable rollout, with the gradient of its final height by the reverse pass."""

    def __init__(self, worlds: int, double: bool, device: str | None):
        """Build the rollout and its inputs for a number of worlds; double: compute in double precision."""
        model = build_model(worlds, visuals=False, device=device)
        self.rollout = Rollout(
            model, jumping_motors(), vertical_jump_filter(), double=double, tolerance=TOLERANCE, threads=1
        )
        self._q, self._qd = (self.rollout.array(np.repeat(row, worlds, axis=1)) for row in compact(*start()))
        self._targets = self.rollout.array(np.repeat(schedule(PUSH)[:, :, None], worlds, axis=2))
        trajectory = self.forward()
        cotangent = np.zeros(trajectory.q.shape)
        cotangent[-1, 2] = 1.0
        self._cotangent = self.rollout.array(cotangent)

    def forward(self) -> Trajectory:
        """Simulate the jump by the rollout, and return the trajectory."""
        return self.rollout.run(self._targets, self._q, self._qd)

    def run(self) -> dict[str, wp.array]:
        """Simulate the jump, and return the gradients of the final base height with respect to all inputs.

        Keys: as `Rollout.backward`.
        """
        return self.rollout.backward(self.forward(), q=self._cotangent)
