"""One time step of the dedicated dynamics on Warp's tape."""

from __future__ import annotations

from typing import Any

import warp as wp

from jumper_warp.sim.dynamics import JumperDynamics
from jumper_warp.utils.errors import InputError


class DifferentiableStep:
    """Launches the step kernel by kernel so that `wp.Tape` can run it backwards; each call makes its own buffers.

    Gradients flow to the state, the joint forces, the external wrench and the parameter table. At given contact modes
    and pressed stops they are exact; see `kernels.dynamics.adjoint.differentiable` for what happens where one changes.
    """

    def __init__(self, dynamics: JumperDynamics, max_sweeps: int, tolerance: float):
        """tolerance [m/s]: of the contact iteration, whose error the gradients inherit."""
        self._dynamics = dynamics
        self._max_sweeps = max_sweeps
        self._tolerance = tolerance

    def _zeros(self, shape: int | tuple[int, ...], dtype: Any, grad: bool = True) -> wp.array:
        return wp.zeros(shape, dtype=dtype, device=self._dynamics.device, requires_grad=grad)

    def _fields(self, struct: Any, shape: int | tuple[int, ...]) -> Any:
        """Return a kernel struct with fresh arrays for all of its fields."""
        instance = struct()
        for name, var in struct.vars.items():
            setattr(instance, name, self._zeros(shape, var.type.dtype))
        return instance

    def _velocities(self) -> Any:
        n, modules = self._dynamics.num_worlds, self._dynamics.modules
        velocities = modules.differentiable.Velocities()
        velocities.lin = self._zeros(n, modules.scalar.vec3)
        velocities.ang = self._zeros(n, modules.scalar.vec3)
        velocities.rates = self._zeros((4, n), modules.scalar.vec3)
        return velocities

    def step(
        self,
        q: wp.array,
        qd: wp.array,
        joint_f: wp.array,
        body_f: wp.array,
        q_out: wp.array,
        qd_out: wp.array,
        dt: float,
    ) -> None:
        """Advance base and motor coordinates by dt [s]; arrays as in `JumperDynamics.advance`, none shared.

        Raises ValueError if the result would overwrite what the step read, or if there are blocks.
        """
        if q.ptr == q_out.ptr or qd.ptr == qd_out.ptr:
            raise InputError("a differentiable step needs its own output state: state_out must not be state_in")
        if self._dynamics.robot.ground.blocks.shape[0] > 0:
            raise InputError("a step with a moving block is not differentiable")
        dyn, n = self._dynamics, self._dynamics.num_worlds
        robot, kernels, adjoint = dyn.robot, dyn.modules.differentiable, dyn.modules.contact_adjoint
        legs = self._fields(kernels.LegArrays, (4, n))
        base = self._fields(kernels.BaseArrays, n)
        common = [robot.geometry, robot.ground, robot.table, q, qd, legs]
        solution = self._settle(q, qd, joint_f, body_f, dt)
        motors = [robot.geometry, robot.table, q, qd, joint_f, solution.pressed, dt]
        self._launch(kernels.legs_kernel, (4, n), motors, [legs])
        self._launch(kernels.base_kernel, n, [robot.table, q, qd, joint_f, body_f, legs], [base])
        ahead, velocities = self._velocities(), self._velocities()
        residual = self._zeros((4, n), dyn.modules.scalar.vec3)
        self._launch(kernels.velocity_kernel, n, [*common, base, solution.impulse, dt], [ahead])
        self._launch(
            kernels.residual_kernel,
            (4, n),
            [*common, ahead, solution.impulse, solution.mode, solution.mu_row, solution.pressed, dt],
            [residual],
        )
        tape = wp._src.context.runtime.tape
        if tape is not None:
            tape.record_func(
                lambda: self._launch(
                    adjoint.implicit_kernel,
                    n,
                    [robot, q, qd, legs, base, ahead, solution, dt],
                    [solution.impulse.grad, residual.grad],
                    record=False,
                ),
                [solution.impulse, residual],
            )
        self._launch(kernels.velocity_kernel, n, [*common, base, solution.impulse, dt], [velocities])
        self._launch(kernels.integrate_kernel, n, [robot.table, q, qd, velocities, dt], [q_out, qd_out])

    def _settle(self, q: wp.array, qd: wp.array, joint_f: wp.array, body_f: wp.array, dt: float) -> Any:
        """Return the solved contacts and stops; not on the tape."""
        dyn, n = self._dynamics, self._dynamics.num_worlds
        solution = dyn.modules.contact_adjoint.Solution()
        solution.impulse = self._zeros((4, n), dyn.modules.scalar.vec3)
        for name in ("mode", "mu_row", "pressed"):
            setattr(solution, name, self._zeros((4, n), wp.int32, grad=False))
        self._launch(
            dyn.modules.contact_adjoint.settle_kernel,
            n,
            [dyn.robot, dyn.settings(dt, 1, self._max_sweeps, self._tolerance), q, qd, joint_f, body_f],
            [dyn.work.impulse, solution, dyn.work.contact_force],
            record=False,
        )
        return solution

    def _launch(
        self, kernel: wp.Kernel, dim: int | tuple[int, ...], inputs: list, outputs: list, record: bool = True
    ) -> None:
        wp.launch(kernel, dim=dim, inputs=inputs, outputs=outputs, device=self._dynamics.device, record_tape=record)
