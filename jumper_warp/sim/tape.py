"""Time step of the robot's dynamics that Warp's tape can differentiate."""

from __future__ import annotations

from typing import Any

import warp as wp

from jumper_warp.sim.dynamics import JumperDynamics
from jumper_warp.utils.errors import InputError


class DifferentiableStep:
    """Time step of the robot's dynamics that `wp.Tape` can differentiate; each call allocates its buffers.

    Gradients reach the state, the joint forces, the external wrench and the parameter table. They are exact at the
    contact modes and pressed stops of the step; see `kernels.dynamics.adjoint.tape_step`.
    """

    def __init__(self, dynamics: JumperDynamics, max_sweeps: int, tolerance: float):
        """Store the dynamics and the settings of the contact solver for later steps.

        max_sweeps, tolerance [m/s]: of the contact iteration, whose error gradients have.
        """
        self._dynamics = dynamics
        self._max_sweeps = max_sweeps
        self._tolerance = tolerance
        self._record: Any = None

    def step(
        self, q: wp.array, qd: wp.array, joint_f: wp.array, body_f: wp.array, q_out: wp.array, qd_out: wp.array,
        dt: float,
    ) -> None:  # fmt: skip
        """Advance all robots by one step of dt [s], and write base and motor coordinates to q_out and qd_out.

        q, qd: as in `JumperDynamics.advance`; joint_f, body_f: as in `JumperDynamics.drive`. Raises InputError: an
        output is an input, or there are moving blocks.
        """
        if q.ptr == q_out.ptr or qd.ptr == qd_out.ptr:
            raise InputError("a differentiable step needs its own output state: state_out must not be state_in")
        if self._dynamics.robot.ground.blocks.shape[0] > 0:
            raise InputError("a step with a moving block is not differentiable")
        dynamics, n = self._dynamics, self._dynamics.num_worlds
        if self._record is None:
            self._record = dynamics.step_record(1)
        robot, solved, device = dynamics.robot, self._solved(), dynamics.device
        settings = dynamics.settings(dt, 1, self._max_sweeps, self._tolerance)
        kernels, power = dynamics.modules.tape_step, wp.zeros((4, n), dynamics.real, device, requires_grad=True)
        inputs = [robot, settings, dynamics.drive(joint_f, body_f), q, qd, dynamics.work]
        wp.launch(kernels.solve_kernel, n, inputs, [solved], device=device, record_tape=False)
        inputs = [robot, dt, q, qd, joint_f, body_f, solved]
        wp.launch(kernels.power_kernel, (4, n), inputs, [power], device=device)
        wp.launch(kernels.integrate_kernel, n, [*inputs, self._record, power], [q_out, qd_out], device=device)

    def _solved(self) -> Any:
        """Allocate the results of solving one step of all worlds: contact modes, impulses and torques, all zero."""
        dynamics, n = self._dynamics, self._dynamics.num_worlds
        solved, trajectory = dynamics.modules.tape_step.SolvedStep(), dynamics.modules.trajectory.TrajectoryArrays()
        for name, shape in {"torque": (1, 12, n), "impulse": (1, 4, n), "pressed": (1, 4, n)}.items():
            setattr(trajectory, name, wp.zeros(shape, trajectory._cls.vars[name].type.dtype, dynamics.device))
        trajectory.q = trajectory.qd = wp.zeros((0, 0, 0), dynamics.real, dynamics.device)
        solved.trajectory = trajectory
        for name, var in solved._cls.vars.items():
            if name != "trajectory":
                shape = n if var.type.ndim == 1 else (4, n)
                setattr(solved, name, wp.zeros(shape, var.type.dtype, dynamics.device))
        return solved
