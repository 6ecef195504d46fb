"""Reverse pass of a rollout: all its steps in one launch, with one thread per world.

The pass goes backwards from row to row. It recomputes the steps between two rows with the impulses of the rollout, then
differentiates them one by one, backwards (`step_adjoint`, `virtual_power`). Storing only rows saves memory, and known
impulses save the contact iteration.

A row holds the base's position and orientation (xyzw), velocity of its centre of mass and angular velocity (world
axes), then the motors (lateral, outer, inner of FL, FR, BL, BR); `BaseState` has the velocity of the origin and the
angular velocity in body axes. A cotangent is the gradient of the loss w.r.t. a result; the adjoint of a function maps
it to the gradient w.r.t. the arguments. `legs`, `sums`: the thread's gradients w.r.t. motors and parameters so far.
"""

from typing import Any

import warp as wp

from ...actuation.motors import MotorParams, motor_torque
from ...layout import BASE
from ...scalar import quat, real, vec3
from ...state import BaseState, base_com
from ..parameters import load_moments, load_spring, load_stops
from ..step import LegParams, RobotModel, StepSettings, load_leg
from ..trajectory import (
    Actuation,
    Arrival,
    Commands,
    Timing,
    TrajectoryArrays,
    arrival,
    load_filter,
    load_row_base,
    load_world_motor,
    row_base,
    row_quat,
    row_vec3,
    store_row_vec3,
)
from . import command_adjoint
from .command_adjoint import FilterAdjoint, MotorAdjoint
from .gradients import GRADIENT_ROWS, Gradients, NoSums, add_com, add_filter
from .multipliers import LegReverse, ReplayedStep, StepRecord, replay_step
from .step_adjoint import reverse_step
from .virtual_power import BaseCotangent, BaseFactors, LegFactors, base_action, leg_action, rotation_adjoint_scalar

wp.set_module_options({"enable_backward": False})


@wp.func
def row_adjoint_scalar(pos: vec3, orientation: quat, com_lin: vec3, ang: vec3, com: vec3, cotangent: BaseState) -> real:
    """Return a scalar whose gradient (`wp.grad`) is the adjoint of `row_base`: dot(cotangent, base state of a row)."""
    base = row_base(pos, orientation, com_lin, ang, com)
    return (
        wp.dot(cotangent.pos, base.pos)
        + wp.dot(cotangent.quat, base.quat)
        + wp.dot(cotangent.lin, base.lin)
        + wp.dot(cotangent.ang, base.ang)
    )


@wp.func
def store_adjoint_scalar(
    orientation: quat, lin: vec3, omega: vec3, com: vec3, lin_cotangent: vec3, ang_cotangent: vec3
) -> real:
    """Return a scalar whose gradient (`wp.grad`) is the adjoint of `store_row_base`: dot(cotangents, velocities).

    orientation (xyzw), lin [m/s], omega [rad/s] of the `BaseState`; com [m]: body frame; cotangents: world axes.
    """
    ang = wp.quat_rotate(orientation, omega)
    return wp.dot(ang_cotangent, ang) + wp.dot(lin_cotangent, lin + wp.cross(ang, wp.quat_rotate(orientation, com)))


@wp.struct
class RowCotangent:
    """Gradient of the loss w.r.t. the base's entries of a trajectory row, world axes."""

    pos: vec3
    quat: quat
    lin: vec3  # w.r.t. the com's velocity, world axes
    ang: vec3  # w.r.t. the angular velocity, world axes
    com: vec3  # w.r.t. the base's centre of mass, summed over rows


@wp.func
def load_row_base_adjoint(
    trajectory: TrajectoryArrays, model: RobotModel, row: int, world: int, adj: BaseState, later_com: vec3
) -> RowCotangent:
    """Return the gradient w.r.t. a trajectory row's base entries: the adjoint of `load_row_base`.

    adj: gradient w.r.t. the base's state that was read from the row. later_com: gradient w.r.t. the centre of mass of
    the base, summed over the later rows; the centre of mass converts the velocities of rows.
    """
    com = base_com(model.table, world)
    pos, orientation, lin, ang, com_adj, _cotangent = wp.grad(row_adjoint_scalar)(
        row_vec3(trajectory.q, row, 0, world), row_quat(trajectory.q, row, 3, world),
        row_vec3(trajectory.qd, row, 0, world), row_vec3(trajectory.qd, row, 3, world), com, adj,
    )  # fmt: skip
    cotangent = RowCotangent()
    cotangent.pos = pos
    cotangent.quat = orientation
    cotangent.lin = lin
    cotangent.ang = ang
    cotangent.com = later_com + com_adj
    return cotangent


@wp.func
def add_row_cotangent(into: RowCotangent, cotangent: TrajectoryArrays, row: int, world: int) -> RowCotangent:
    """Return `into` plus the gradient of the loss w.r.t. the base entries of a trajectory row, from `cotangent`.

    `into` holds the effect of the row on later ones, `cotangent` its direct effect on the loss. Empty arrays mean 0.
    """
    s = into
    if cotangent.q.shape[0] > 0:
        s.pos += row_vec3(cotangent.q, row, 0, world)
        s.quat += row_quat(cotangent.q, row, 3, world)
    if cotangent.qd.shape[0] > 0:
        s.lin += row_vec3(cotangent.qd, row, 0, world)
        s.ang += row_vec3(cotangent.qd, row, 3, world)
    return s


@wp.struct
class RowBaseAdjoint:
    """Gradient of the loss w.r.t. the base's state that was written to a trajectory row."""

    base: BaseState
    com: vec3  # w.r.t. the base's centre of mass, summed over rows


@wp.func
def store_row_base_adjoint(model: RobotModel, world: int, base: BaseState, cotangent: RowCotangent) -> RowBaseAdjoint:
    """Return the gradient w.r.t. the base state that was written to a trajectory row: the adjoint of `store_row_base`.

    base: the written state. cotangent: gradient w.r.t. the entries of the row.
    """
    com = base_com(model.table, world)
    orientation, lin, ang, com_adj, _lin, _ang = wp.grad(store_adjoint_scalar)(
        base.quat, base.lin, base.ang, com, cotangent.lin, cotangent.ang
    )
    adj = RowBaseAdjoint()
    adj.base.pos = cotangent.pos
    adj.base.quat = cotangent.quat + orientation
    adj.base.lin = lin
    adj.base.ang = ang
    adj.com = cotangent.com + com_adj
    return adj


@wp.func
def add_motor_rows(legs: wp.array(dtype=LegReverse), cotangent: TrajectoryArrays, row: int, world: int):
    """Add the gradient of the loss w.r.t. motor angles and rates of a trajectory row, from `cotangent`, to `legs`.

    `cotangent` is the direct effect of the row on the loss; `legs` has the effect through later rows. Empty arrays mean
    0.
    """
    for k in range(legs.shape[0]):
        if cotangent.q.shape[0] > 0:
            legs[k].angles = legs[k].angles + row_vec3(cotangent.q, row, 7 + 3 * k, world)
        if cotangent.qd.shape[0] > 0:
            legs[k].rates = legs[k].rates + row_vec3(cotangent.qd, row, 6 + 3 * k, world)


@wp.func
def load_parts(
    model: RobotModel, actuation: Actuation, world: int, params: wp.array(dtype=LegParams),
    motors: wp.array(dtype=MotorParams),
):  # fmt: skip
    """Load the parameters of a world's legs into params (4,) and of its motors into motors (12,)."""
    for k in range(params.shape[0]):
        params[k] = load_leg(model, world, k)
    for i in range(motors.shape[0]):
        motors[i] = load_world_motor(actuation, i, world)


@wp.func
def replayed_step(commands: Commands, t: int, dt: real, world: int) -> ReplayedStep:
    """Return a `ReplayedStep` with the time step, world and base wrench of policy step t; all else is 0."""
    at = ReplayedStep()
    at.dt = dt
    at.world = world
    at.force = row_vec3(commands.wrench, t, 0, world)
    at.moment = row_vec3(commands.wrench, t, 3, world)
    return at


@wp.func
def replay_row(
    model: RobotModel, params: wp.array(dtype=LegParams), policy_step: ReplayedStep, trajectory: TrajectoryArrays,
    row: int, every: int, com: vec3, record: StepRecord,
):  # fmt: skip
    """Recompute and record the `every` physics steps between two trajectory rows; com [m] of the base, body frame."""
    at = policy_step
    record.base[at.world, 0] = load_row_base(trajectory, row, at.world, com)
    for k in range(record.angles.shape[2]):
        record.angles[at.world, 0, k] = row_vec3(trajectory.q, row, 7 + 3 * k, at.world)
        record.rates[at.world, 0, k] = row_vec3(trajectory.qd, row, 6 + 3 * k, at.world)
    for i in range(every):
        at.step = row * every + i
        at.entry = i
        replay_step(model, params, at, trajectory, record)


@wp.func
def add_wrench(gradients: Gradients, t: int, world: int, force: vec3, moment: vec3):
    """Add force and moment to the stored gradient of the loss w.r.t. the wrench on the base in policy step t.

    The wrench is constant in a policy step, and each physics step adds its part. World axes, at the centre of mass of
    the base.
    """
    store_row_vec3(gradients.wrench, t, 0, world, row_vec3(gradients.wrench, t, 0, world) + force)
    store_row_vec3(gradients.wrench, t, 3, world, row_vec3(gradients.wrench, t, 3, world) + moment)


@wp.func
def add_motor_adjoint(
    by_motor: MotorAdjoint, arrived: Arrival, at: ReplayedStep, motor: int, cotangent: TrajectoryArrays,
    gradients: Gradients, legs: wp.array(dtype=LegReverse), sums: Any,
):  # fmt: skip
    """Backpropagate through a motor's torque in a step, and add the gradients to `legs`, `sums` and `gradients`.

    The torque depends on target, angle, rate and constants (`motor_torque`): each gets the gradient w.r.t. the torque
    times its derivative in `by_motor`. The gradient w.r.t. the torque is its effect on the motion, `legs[k].torque`,
    plus its direct effect on the loss, `cotangent.torque`. Angle and rate go to `legs`, constants to `sums`, targets to
    `gradients`: `arrived` states which two policy targets the motor interpolated. motor: 0 to 11; at: the step.
    """
    k = motor / 3
    c = motor - 3 * k
    torque_cotangent = legs[k].torque[c]
    if cotangent.torque.shape[0] > 0:
        torque_cotangent += cotangent.torque[at.step, motor, at.world]
    command_adjoint.add_targets(gradients, arrived, motor, at.world, torque_cotangent * by_motor.target)
    command_adjoint.add_motor_constants(sums, sums, motor, torque_cotangent, by_motor)
    angles = legs[k].angles
    rates = legs[k].rates
    angles[c] += torque_cotangent * by_motor.angle
    rates[c] += torque_cotangent * by_motor.rate
    legs[k].angles = angles
    legs[k].rates = rates


@wp.func
def add_filter_adjoint(
    by_filter: FilterAdjoint, t: int, k: int, world: int, gradients: Gradients, legs: wp.array(dtype=LegReverse),
    sums: Any,
):  # fmt: skip
    """Store the gradient w.r.t. leg k's targets in policy step t, and add the gradients of its filter's other inputs.

    by_filter: all these gradients. The gradients w.r.t. targets are stored in `gradients`. The gradients w.r.t. angles
    and rates are added to `legs`, and the gradients w.r.t. filter constants and sensor offsets to `sums`.
    """
    store_row_vec3(gradients.target, t, 3 * k, world, by_filter.target)
    command_adjoint.add_offsets(sums, k, by_filter.angles)
    add_filter(sums, by_filter.constants)
    legs[k].angles = legs[k].angles + by_filter.angles
    legs[k].rates = legs[k].rates + by_filter.rates


@wp.func
def store_base_entries(gradients: Gradients, world: int, entries: RowCotangent):
    """Write the gradient w.r.t. the base entries of a trajectory row to `gradients.q` and `gradients.qd`."""
    for i in range(3):
        gradients.q[i, world] = entries.pos[i]
        gradients.qd[i, world] = entries.lin[i]
        gradients.qd[3 + i, world] = entries.ang[i]
    for i in range(4):
        gradients.q[3 + i, world] = entries.quat[i]


@wp.func
def store_motor_entries(gradients: Gradients, world: int, leg: int, angles: vec3, rates: vec3):
    """Write the gradient w.r.t. a leg's motor angles and rates in a trajectory row to `gradients.q`, `gradients.qd`."""
    for i in range(3):
        gradients.q[7 + 3 * leg + i, world] = angles[i]
        gradients.qd[6 + 3 * leg + i, world] = rates[i]


@wp.func
def adjoint_roots(
    factors: LegFactors, base: BaseFactors, base_cotangent: BaseCotangent, model: RobotModel, actuation: Actuation,
    trajectory: TrajectoryArrays, state: BaseState, world: int,
) -> real:  # fmt: skip
    """Call all functions that the reverse pass differentiates, so that Warp generates their adjoints; return a dummy.

    The dummy is the sum of the results, which has no meaning; see `generate_adjoints`.
    """
    params = load_leg(model, world, 0)
    v = row_vec3(trajectory.q, 0, 0, world)
    q = row_quat(trajectory.q, 0, 3, world)
    x = trajectory.q[0, 0, world]
    spring = load_spring(model.table, 0, world)
    stops = load_stops(model.table, 0, world)
    leg = leg_action(
        params.geometry, params.masses, params.joints, spring, stops, model.ground, x, v, q, v, v, v, v, base, factors,
        x,
    )  # fmt: skip
    return (
        leg
        + base_action(load_moments(model.table, BASE, world), v, v, v, v, q, v, v, base, base_cotangent, x)
        + rotation_adjoint_scalar(q, v, x, q)
        + motor_torque(x, x, x, load_world_motor(actuation, 0, world))
        + command_adjoint.filter_adjoint_scalar(v, v, v, load_filter(actuation.limits, world), v)
        + row_adjoint_scalar(v, q, v, v, v, state)
        + store_adjoint_scalar(q, v, v, v, v, v)
    )


def generate_adjoints(module: str) -> wp.Kernel:
    """Return a kernel that makes Warp generate adjoints of all functions that the reverse pass differentiates.

    module: `__name__` of the module of kernels that needs them. `wp.grad` alone omits adjoints of functions that were
    called elsewhere before; a kernel with a backward pass, never launched, includes them all.
    """

    @wp.kernel(enable_backward=True, module=wp.get_module(module))
    def adjoints_kernel(
        factors: LegFactors, base: BaseFactors, base_cotangent: BaseCotangent, model: RobotModel, actuation: Actuation,
        trajectory: TrajectoryArrays, state: BaseState, sums: wp.array(dtype=real),
    ):  # fmt: skip
        world = wp.tid()
        launched = int(0)  # Warp makes the adjoints anyway, and the compiler drops this kernel's own code
        if launched > 0:
            sums[world] = adjoint_roots(factors, base, base_cotangent, model, actuation, trajectory, state, world)

    return adjoints_kernel


def make_reverse_kernel(module: str, by_parameters: bool) -> wp.Kernel:
    """Return the kernel of the reverse pass for a module of kernels, and make Warp generate the adjoints it calls.

    module: `__name__` of the module. by_parameters: whether to compute gradients w.r.t. the robot's parameters.
    """
    generate_adjoints(module)

    @wp.kernel(module=wp.get_module(module))
    def reverse_kernel(
        # in
        model: RobotModel,
        settings: StepSettings,
        timing: Timing,
        actuation: Actuation,
        commands: Commands,
        filtered_target: wp.array3d(dtype=real),
        trajectory: TrajectoryArrays,
        cotangent: TrajectoryArrays,
        # out
        record: StepRecord,
        gradients: Gradients,
    ):
        """Compute the gradient of a loss w.r.t. all inputs of a rollout; one thread per world.

        cotangent: gradient w.r.t. the trajectory. filtered_target [rad]: (T, 12, num_worlds), from the forward pass,
        like `trajectory`. record: scratch for `timing.every` steps. Worlds count from `settings.first`.
        """
        world = settings.first + wp.tid()
        legs = wp.zeros(shape=(4,), dtype=LegReverse)
        if wp.static(by_parameters):
            sums = wp.zeros(shape=(GRADIENT_ROWS,), dtype=real)
        else:
            sums = NoSums()
        params = wp.zeros(shape=(4,), dtype=LegParams)
        motors = wp.zeros(shape=(12,), dtype=MotorParams)
        load_parts(model, actuation, world, params, motors)
        delay = actuation.latency[world] / settings.dt
        last = timing.steps * timing.substeps / timing.every
        entries = add_row_cotangent(RowCotangent(), cotangent, last, world)
        add_motor_rows(legs, cotangent, last, world)
        com = base_com(model.table, world)
        for back in range(last):
            row = last - 1 - back
            t = row * timing.every / timing.substeps
            at = replayed_step(commands, t, settings.dt, world)
            replay_row(model, params, at, trajectory, row, timing.every, com, record)
            end = store_row_base_adjoint(model, world, record.base[world, timing.every], entries)
            adj = end.base
            for j in range(timing.every):
                at.entry = timing.every - 1 - j
                at.step = row * timing.every + at.entry
                by_step = reverse_step(
                    model, params, at, commands.impulse, trajectory, cotangent, record, adj, legs, sums,
                )  # fmt: skip
                adj = by_step.base
                add_wrench(gradients, t, world, by_step.force, by_step.moment)
                arrived = arrival(at.step, timing.substeps, delay)
                for i in range(motors.shape[0]):
                    angle = record.angles[world, at.entry, i / 3][i % 3]
                    rate = record.rates[world, at.entry, i / 3][i % 3]
                    by_motor = command_adjoint.motor_gradient(
                        motors[i], delay, commands, filtered_target, timing, at.dt, at.step, i, world, angle, rate
                    )
                    add_motor_adjoint(by_motor, arrived, at, i, cotangent, gradients, legs, sums)
            entries = add_row_cotangent(
                load_row_base_adjoint(trajectory, model, row, world, adj, end.com), cotangent, row, world
            )
            if row * timing.every == t * timing.substeps:
                for k in range(legs.shape[0]):
                    by_filter = command_adjoint.filter_gradient(
                        commands, actuation, t, k, world, record.angles[world, 0, k], record.rates[world, 0, k],
                        gradients,
                    )  # fmt: skip
                    add_filter_adjoint(by_filter, t, k, world, gradients, legs, sums)
            add_motor_rows(legs, cotangent, row, world)
        add_com(sums, model.table[BASE, world], com, entries.com)
        if wp.static(by_parameters):
            for i in range(sums.shape[0]):
                gradients.parameters[i, world] = sums[i]
        store_base_entries(gradients, world, entries)
        for k in range(legs.shape[0]):
            store_motor_entries(gradients, world, k, legs[k].angles, legs[k].rates)

    return reverse_kernel


reverse_kernel = make_reverse_kernel(__name__, by_parameters=True)
