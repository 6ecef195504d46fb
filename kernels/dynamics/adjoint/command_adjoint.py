"""Reverse pass of motors, latency and command filter: from gradients w.r.t. torques to targets and constants.

Motors are 0 to 11 (legs FL, FR, BL, BR; each lateral, outer, inner). A cotangent is the gradient of the loss w.r.t. a
result, from which the gradient w.r.t. the inputs follows. `sums` takes gradients w.r.t. parameters of one leg or motor,
`shared` gradients w.r.t. parameters that all motors of a world share. On a GPU, the two are first summed over different
threads (`ThreadSums`). On a CPU, both are the same array of one world.
"""

from typing import Any

import warp as wp

from ...actuation.command_filter import FilterParams, filter_leg
from ...actuation.motors import MotorParams, motor_torque
from ...scalar import real, vec3
from ..trajectory import Actuation, Arrival, Commands, Timing, arrival, load_filter, policy_target, row_vec3
from .gradients import LATENCY_GRADIENT, MOTOR_GRADIENT, Gradients, add_entry, add_motor, add_vec3

wp.set_module_options({"enable_backward": False})


@wp.struct
class MotorAdjoint:
    """Derivatives of a motor's torque w.r.t. its target, joint state, constants and latency."""

    target: real  # [N m/rad] w.r.t. the target that it follows
    angle: real  # [N m/rad] w.r.t. the joint angle
    rate: real  # [N m s/rad] w.r.t. the joint rate
    constants: MotorParams  # [N m] per unit of each constant
    latency: real  # [N m/s] w.r.t. the latency


@wp.struct
class FilterAdjoint:
    """Gradient of the loss w.r.t. the inputs of a leg's command filter; vectors are lateral, outer, inner."""

    target: vec3  # w.r.t. the raw targets
    angles: vec3  # w.r.t. the measured angles
    rates: vec3
    constants: FilterParams  # w.r.t. each of them


@wp.func
def add_target(gradients: Gradients, step: int, motor: int, world: int, gradient: real):
    """Add a number to the stored gradient of the loss w.r.t. a motor's filtered target of one policy step.

    A motor follows a target in several physics steps, and each of these adds its part. step: policy step; below 0 for
    the initial targets, see `policy_target`.
    """
    if step < 0:
        # atomic to avoid a load: no other thread writes here
        earlier = wp.max(gradients.initial_target.shape[0] + step, 0)
        wp.atomic_add(gradients.initial_target, earlier, motor, world, gradient)
    else:
        wp.atomic_add(gradients.filtered_target, step, motor, world, gradient)


@wp.func
def motor_gradient(
    params: MotorParams, delay: real, commands: Commands, filtered_target: wp.array3d(dtype=real), timing: Timing,
    dt: real, step: int, motor: int, world: int, angle: real, rate: real,
) -> MotorAdjoint:  # fmt: skip
    """Return the derivatives of a motor's torque in a physics step w.r.t. target, joint state, constants and latency.

    step: physics step of dt [s], at angle [rad], rate [rad/s]. params: the motor's constants. delay: latency in physics
    steps, a real number: the target is interpolated between two policy targets, so that it has a derivative w.r.t. the
    latency. filtered_target [rad]: (T, 12, num_worlds).
    """
    adjoint = MotorAdjoint()
    arrived = arrival(step, timing.substeps, delay)
    newer = policy_target(filtered_target, commands.initial_target, arrived.newer, motor, world)
    older = newer
    target = newer
    if arrived.newer > arrived.older:
        older = policy_target(filtered_target, commands.initial_target, arrived.older, motor, world)
        if arrived.weight != real(1.0):
            target = older + arrived.weight * (newer - older)
    by_target, by_angle, by_rate, by_motor = wp.grad(motor_torque)(target, angle, rate, params)
    adjoint.target = by_target
    adjoint.angle = by_angle
    adjoint.rate = by_rate
    adjoint.constants = by_motor
    adjoint.latency = -by_target * (newer - older) / dt
    return adjoint


@wp.func
def add_targets(gradients: Gradients, arrived: Arrival, motor: int, world: int, gradient: real):
    """Distribute the gradient w.r.t. a motor's interpolated target, by weight, to the two targets around it."""
    add_target(gradients, arrived.newer, motor, world, arrived.weight * gradient)
    if arrived.newer > arrived.older:
        add_target(gradients, arrived.older, motor, world, (real(1.0) - arrived.weight) * gradient)


@wp.func
def add_motor_constants(sums: Any, shared: Any, motor: int, cotangent: real, adjoint: MotorAdjoint):
    """Add a physics step's gradient of the loss w.r.t. a motor's constants and latency to the stored gradients.

    By the chain rule, this gradient is `cotangent`, the gradient w.r.t. the torque of the motor, times the derivatives
    of the torque in `adjoint`. `sums` gets gains, limits and sensor offset, which belong to one motor. `shared` gets
    over-speed limits and latency, which the motors of a world share. sums, shared: rows of GRADIENT_ROWS, see
    `add_entry`.
    """
    add_motor(sums, shared, motor, cotangent, adjoint.constants)
    add_entry(shared, LATENCY_GRADIENT, cotangent * adjoint.latency)


@wp.func
def filter_adjoint_scalar(target: vec3, angles: vec3, rates: vec3, params: FilterParams, cotangent: vec3) -> real:
    """Return a scalar whose gradient (`wp.grad`) is the adjoint of `filter_leg`: dot(cotangent, filtered targets)."""
    return wp.dot(cotangent, filter_leg(target, angles, rates, params))


@wp.func
def filter_gradient(
    commands: Commands, actuation: Actuation, step: int, leg: int, world: int, angles: vec3, rates: vec3,
    gradients: Gradients,
) -> FilterAdjoint:  # fmt: skip
    """Return the gradient of the loss w.r.t. the inputs of a leg's command filter (`filter_leg`) in a policy step.

    The function reads the gradient w.r.t. the filtered targets from `gradients`. angles [rad], rates [rad/s] of the
    leg's motors at the start of the policy step. Without a filter the gradient passes to the target unchanged.
    """
    m = 3 * leg
    adjoint = FilterAdjoint()
    cotangent = row_vec3(gradients.filtered_target, step, m, world)
    adjoint.target = cotangent
    if actuation.filtered != 0:
        offset = actuation.motors.offset
        measured = angles + vec3(offset[m, world], offset[m + 1, world], offset[m + 2, world])
        target = row_vec3(commands.target, step, m, world)
        by_target, by_angles, by_rates, by_params, _cotangent = wp.grad(filter_adjoint_scalar)(
            target, measured, rates, load_filter(actuation.limits, world), cotangent
        )
        adjoint.target = by_target
        adjoint.angles = by_angles
        adjoint.rates = by_rates
        adjoint.constants = by_params
    return adjoint


@wp.func
def add_offsets(sums: Any, leg: int, by_angles: vec3):
    """Add the gradient w.r.t. a leg's measured angles to the gradient w.r.t. its position sensors' offsets.

    A measured angle is the true angle plus the offset, so both have the same gradient. The offsets' rows follow six
    constants of all 12 motors.
    """
    add_vec3(sums, MOTOR_GRADIENT + 72 + 3 * leg, by_angles)
