"""Rollouts on Warp's tape: policy steps of filter, motors and physics, and the height that a jump reaches."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import newton
import warp as wp

from jumper_warp.robot.model import PHYSICS_DT
from jumper_warp.robot.motors import FilterCfg, MotorCfg, filter_params, jumping_motors, motor_arrays
from jumper_warp.sim.differentiable import DifferentiableStep
from jumper_warp.sim.dynamics import JumperDynamics
from jumper_warp.sim.simulation import SUBSTEPS
from jumper_warp.utils.errors import InputError
from kernels.layout import COORDS, DOFS, GRAVITY

MAX_SWEEPS = 200
"""Most sweeps of the contact iteration in a step."""
TOLERANCE = 1.0e-6
"""[m/s] Of the contact iteration in single precision. Gradients inherit its error."""
TOLERANCE_DOUBLE = 1.0e-13
"""[m/s] The same in double precision."""


@wp.kernel
def _base_motion_kernel(
    # in
    joint_q: wp.array(dtype=Any),
    joint_qd: wp.array(dtype=Any),
    row: int,
    # out
    height: wp.array2d(dtype=Any),
    speed: wp.array2d(dtype=Any),
):
    """Store the height [m] of the base and the vertical speed [m/s] of its centre of mass in a row."""
    world = wp.tid()
    height[row, world] = joint_q[COORDS * world + 2]
    speed[row, world] = joint_qd[DOFS * world + 2]


@wp.kernel(enable_backward=False)
def _touch_kernel(
    # in
    impulse: wp.array2d(dtype=Any),
    row: int,
    # out
    touching: wp.array2d(dtype=int),
):
    """Store whether any paw pushed on the ground in a step, 0 or 1."""
    world = wp.tid()
    touching[row, world] = 0
    for k in range(4):
        if wp.length_sq(impulse[k, world]) > impulse.dtype.dtype(0.0):
            touching[row, world] = 1


@wp.kernel(enable_backward=False)
def _find_apex_kernel(
    # in
    height: wp.array2d(dtype=Any),
    touching: wp.array2d(dtype=int),
    # out
    apex_row: wp.array(dtype=int),
    takeoff_row: wp.array(dtype=int),
):
    """Find the row of the largest height, and the last row up to there that ends a step with a paw on the ground."""
    world = wp.tid()
    apex = wp.int32(0)
    for row in range(1, height.shape[0]):
        if height[row, world] > height[apex, world]:
            apex = row
    takeoff = wp.int32(apex)
    while takeoff > 0 and touching[takeoff, world] == 0:
        takeoff -= 1
    apex_row[world] = apex
    takeoff_row[world] = takeoff


@wp.kernel
def _gather_kernel(
    # in
    values: wp.array2d(dtype=Any),
    row: wp.array(dtype=int),
    # out
    picked: wp.array(dtype=Any),
):
    """Pick one row per world."""
    world = wp.tid()
    picked[world] = values[row[world], world]


@wp.kernel
def _ballistic_kernel(
    # in
    height: wp.array2d(dtype=Any),
    speed: wp.array2d(dtype=Any),
    row: wp.array(dtype=int),
    table: wp.array2d(dtype=Any),
    # out
    apex: wp.array(dtype=Any),
):
    """Height [m] that free flight from a row leads to."""
    world = wp.tid()
    fall = -table[GRAVITY + 2, world]
    up = wp.max(speed[row[world], world], speed.dtype(0.0))
    apex[world] = height[row[world], world] + up * up / (fall + fall)


@dataclass(frozen=True)
class Trajectory:
    """What a rollout of K physics steps left behind; all arrays but the integer ones carry gradients."""

    joint_q: list[wp.array]
    """Coordinates before each step and at the end, K + 1 arrays of shape (43 num_worlds,); passive joints stay 0."""
    joint_qd: list[wp.array]
    """Rates, K + 1 arrays of shape (38 num_worlds,)."""
    height: wp.array
    """[m] Of the base, world frame, shape (K + 1, num_worlds)."""
    speed: wp.array
    """[m/s] Vertical, of the base's centre of mass, shape (K + 1, num_worlds)."""
    touching: wp.array
    """1 where a paw pushed on the ground in the step that ends here, shape (K + 1, num_worlds); row 0 is 0."""
    apex_row: wp.array
    """Row of the largest height, shape (num_worlds,)."""
    takeoff_row: wp.array
    """End of the last step with contact up to the apex, shape (num_worlds,); 0 without one."""
    apex: wp.array
    """[m] Largest base height, shape (num_worlds,): the height at `apex_row`.

    Its gradient is that of the height at this fixed row, which is the gradient of the maximum except where two rows
    tie. It is zero for what happens after that row.
    """
    ballistic_apex: wp.array
    """[m] z + vz^2 / 2g of the base at `takeoff_row` (z alone while it falls), shape (num_worlds,).

    It needs no flight to be simulated and leaves out what the legs do in it. The takeoff row is held like the apex's.
    """


class DifferentiableRollout:
    """Runs policy steps on an active `wp.Tape`: the filter once, then `substeps` times motors and physics.

    Gradients reach the targets, the initial state, the motor constants in `motors` (such as `motors.saturation.grad`)
    and the parameter table `dynamics.robot.table`. To carry them on to the model's masses or friction coefficients,
    record `dynamics.pack_masses()` or `dynamics.pack_friction()` on the tape, before `run`. At given contact modes and
    branches of filter and motors they are exact; see `kernels.dynamics.differentiable` for contacts.
    """

    def __init__(
        self,
        model: newton.Model,
        motors: MotorCfg | None = None,
        command_filter: FilterCfg | None = None,
        *,
        double: bool = False,
        dt: float = PHYSICS_DT,
        substeps: int = SUBSTEPS,
    ):
        """Prepare for a model of `jumper_warp.robot.model.build_model` with `requires_grad`.

        Args:
            model: The robot's worlds.
            motors: By default the jumping gains at 18 N m.
            command_filter: None leaves the targets as they are.
            double: Whether to compute in double precision.
            dt: Physics step [s].
            substeps: Physics steps in a policy step.

        Raises:
            NotThisRobotError: the model is another robot's.
            ValueError: dt not positive, substeps below 1, or a model without gradients.
        """
        if not dt > 0.0 or substeps < 1:
            raise InputError(f"dt must be > 0 and substeps >= 1, got {dt}, {substeps}")
        if not model.requires_grad:
            raise InputError("the model carries no gradients: build it with requires_grad=True")
        self.dynamics = JumperDynamics(model, double=double)
        self.num_worlds = model.world_count
        self.real = self.dynamics.real
        self.dt = dt
        self.substeps = substeps
        modules = self.dynamics.modules
        self.motors = motor_arrays(
            motors or jumping_motors(),
            self.num_worlds,
            module=modules.motors,
            device=model.device,
            requires_grad=True,
        )
        self._filter = command_filter and filter_params(command_filter, module=modules.command_filter)
        self._step = DifferentiableStep(self.dynamics, MAX_SWEEPS, TOLERANCE_DOUBLE if double else TOLERANCE)
        self._no_body_f = wp.zeros(model.body_count, dtype=wp.spatial_vector, device=model.device, requires_grad=True)

    def run(self, targets: wp.array, joint_q: wp.array, joint_qd: wp.array) -> Trajectory:
        """Simulate, starting without contact history.

        Args:
            targets: Raw motor targets [rad] of T policy steps, `real`, shape (T, 12, num_worlds).
            joint_q: Initial coordinates, `real`, shape (43 num_worlds,), laid out as Newton's.
            joint_qd: Initial rates, `real`, shape (38 num_worlds,).

        Raises:
            ValueError: an array of another shape or type.
        """
        self._check(targets, joint_q, joint_qd)
        work = self.dynamics.work
        work.impulse.zero_()
        steps = targets.shape[0] * self.substeps
        height, speed = (self._zeros((steps + 1, self.num_worlds)) for _ in range(2))
        touching = wp.zeros((steps + 1, self.num_worlds), dtype=int, device=self.dynamics.device)
        q, qd = [joint_q], [joint_qd]
        self._launch(_base_motion_kernel, self.num_worlds, [joint_q, joint_qd, 0], [height, speed])
        for step in range(steps):
            if step % self.substeps == 0:
                target = self._filtered(targets[step // self.substeps], q[-1], qd[-1])
            new_q, new_qd = self._zeros(joint_q.shape), self._zeros(joint_qd.shape)
            self._physics(target, q[-1], qd[-1], new_q, new_qd)
            q.append(new_q)
            qd.append(new_qd)
            self._launch(_base_motion_kernel, self.num_worlds, [new_q, new_qd, step + 1], [height, speed])
            self._launch(_touch_kernel, self.num_worlds, [work.impulse, step + 1], [touching], record=False)
        return Trajectory(q, qd, height, speed, touching, *self._apexes(height, speed, touching))

    def _check(self, targets: wp.array, joint_q: wp.array, joint_qd: wp.array) -> None:
        """Raise ValueError unless the arguments of `run` fit."""
        n = self.num_worlds
        if targets.ndim != 3 or targets.shape[0] < 1 or targets.shape[1:] != (12, n):
            raise InputError(f"targets must have shape (T, 12, {n}) with T >= 1, got {targets.shape}")
        for name, array, count in (("joint_q", joint_q, int(COORDS)), ("joint_qd", joint_qd, int(DOFS))):
            if array.shape != (count * n,):
                raise InputError(f"{name} must have shape ({count * n},), got {array.shape}")
        for name, array in (("targets", targets), ("joint_q", joint_q), ("joint_qd", joint_qd)):
            if array.dtype != self.real:
                raise InputError(f"{name} must be of {self.real.__name__}, got {array.dtype.__name__}")

    def _filtered(self, target: wp.array, q: wp.array, qd: wp.array) -> wp.array:
        """Return the targets [rad] that the filter lets through, shape (12, num_worlds)."""
        if self._filter is None:
            return target
        safe = self._zeros(target.shape)
        kernel = self.dynamics.modules.command_filter.command_filter_kernel
        self._launch(
            kernel, (4, self.num_worlds), [0, target, q, qd, COORDS, DOFS, self.motors.offset, self._filter], [safe]
        )
        return safe

    def _physics(self, target: wp.array, q: wp.array, qd: wp.array, q_out: wp.array, qd_out: wp.array) -> None:
        """Advance one physics step."""
        joint_f = self._zeros(qd.shape)
        kernel = self.dynamics.modules.motors.motor_torque_kernel
        self._launch(kernel, (12, self.num_worlds), [target, q, qd, COORDS, DOFS, self.motors], [joint_f])
        self._step.step(q, qd, joint_f, self._no_body_f, q_out, qd_out, self.dt)

    def _apexes(self, height: wp.array, speed: wp.array, touching: wp.array) -> tuple[wp.array, ...]:
        """Return the last four fields of `Trajectory`."""
        n, device = self.num_worlds, self.dynamics.device
        apex_row, takeoff_row = (wp.zeros(n, dtype=int, device=device) for _ in range(2))
        self._launch(_find_apex_kernel, n, [height, touching], [apex_row, takeoff_row], record=False)
        apex, ballistic = self._zeros(n), self._zeros(n)
        self._launch(_gather_kernel, n, [height, apex_row], [apex])
        table = self.dynamics.robot.table
        self._launch(_ballistic_kernel, n, [height, speed, takeoff_row, table], [ballistic])
        return apex_row, takeoff_row, apex, ballistic

    def _zeros(self, shape: int | tuple[int, ...]) -> wp.array:
        return wp.zeros(shape, dtype=self.real, device=self.dynamics.device, requires_grad=True)

    def _launch(
        self, kernel: wp.Kernel, dim: int | tuple[int, ...], inputs: list, outputs: list, record: bool = True
    ) -> None:
        wp.launch(kernel, dim=dim, inputs=inputs, outputs=outputs, device=self.dynamics.device, record_tape=record)
