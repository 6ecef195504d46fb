"""From gradients by motor torques to those by targets and actuation: motors, latency, command filter, backwards."""

from typing import Any

import warp as wp

from ...actuation.command_filter import FilterParams, filter_leg
from ...actuation.motors import MotorParams, motor_torque
from ...scalar import real, vec3
from ..trajectory import Actuation, Arrival, Commands, Timing, arrival, commanded, load_filter, row_vec3
from .gradients import LATENCY_GRADIENT, MOTOR_GRADIENT, Gradients, add_entry, add_motor, add_vec3

wp.set_module_options({"enable_backward": False})


@wp.struct
class MotorAdjoint:
    """Derivatives of a motor's torque."""

    target: real  # by the target that it follows
    angle: real
    rate: real
    constants: MotorParams
    latency: real


@wp.struct
class FilterAdjoint:
    """Gradient by what a leg's filtered targets depend on."""

    target: vec3
    angles: vec3
    rates: vec3
    constants: FilterParams


@wp.func
def add_target(gradients: Gradients, step: int, motor: int, world: int, x: real):
    """Add to the gradient by a motor's filtered target of a policy step, or by what it followed before the first."""
    if step < 0:
        wp.atomic_add(
            gradients.initial_target, motor, world, x
        )  # no other thread does; so none waits for what was there
    else:
        wp.atomic_add(gradients.filtered_target, step, motor, world, x)


@wp.func
def motor_gradient(
    params: MotorParams, delay: real, commands: Commands, filtered_target: wp.array3d(dtype=real), timing: Timing,
    dt: real, step: int, motor: int, world: int, angle: real, rate: real,
) -> MotorAdjoint:  # fmt: skip
    """Return the derivatives of a motor's torque in a step."""
    found = MotorAdjoint()
    arrived = arrival(step, timing.substeps, delay)
    newer = commanded(filtered_target, commands.initial_target, arrived.newer, motor, world)
    older = newer
    target = newer
    if arrived.newer > arrived.older:
        older = commanded(filtered_target, commands.initial_target, arrived.older, motor, world)
        if arrived.weight != real(1.0):
            target = older + arrived.weight * (newer - older)
    by_target, by_angle, by_rate, by_motor = wp.grad(motor_torque)(target, angle, rate, params)
    found.target = by_target
    found.angle = by_angle
    found.rate = by_rate
    found.constants = by_motor
    found.latency = -by_target * (newer - older) / dt
    return found


@wp.func
def add_targets(gradients: Gradients, arrived: Arrival, motor: int, world: int, x: real):
    """Add a gradient by the target that a motor follows to those by the filtered targets it comes from."""
    add_target(gradients, arrived.newer, motor, world, arrived.weight * x)
    if arrived.newer > arrived.older:
        add_target(gradients, arrived.older, motor, world, (real(1.0) - arrived.weight) * x)


@wp.func
def add_motor_constants(sums: Any, shared: Any, motor: int, cotangent: real, found: MotorAdjoint):
    """Add to the gradients by a motor's constants, and to `shared` by the latency; seed: gradient by its torque."""
    add_motor(sums, shared, motor, cotangent, found.constants)
    add_entry(shared, LATENCY_GRADIENT, cotangent * found.latency)


@wp.func
def filter_adjoint_scalar(target: vec3, angles: vec3, rates: vec3, params: FilterParams, cotangent: vec3) -> real:
    """Return the weighed sum of a leg's filtered targets."""
    return wp.dot(cotangent, filter_leg(target, angles, rates, params))


@wp.func
def filter_gradient(
    commands: Commands, actuation: Actuation, step: int, leg: int, world: int, angles: vec3, rates: vec3,
    gradients: Gradients,
) -> FilterAdjoint:  # fmt: skip
    """Return a leg's gradients for those by its filtered targets of a policy step."""
    m = 3 * leg
    found = FilterAdjoint()
    cotangent = row_vec3(gradients.filtered_target, step, m, world)
    found.target = cotangent
    if actuation.filtered != 0:
        offset = actuation.motors.offset
        read = angles + vec3(offset[m, world], offset[m + 1, world], offset[m + 2, world])
        target = row_vec3(commands.target, step, m, world)
        by_target, by_angles, by_rates, by_params, _cotangent = wp.grad(filter_adjoint_scalar)(
            target, read, rates, load_filter(actuation.limits, world), cotangent
        )
        found.target = by_target
        found.angles = by_angles
        found.rates = by_rates
        found.constants = by_params
    return found


@wp.func
def add_offsets(sums: Any, leg: int, by_angles: vec3):
    """Add to the gradients by the sensors' offsets, given those by the angles that the filter reads."""
    add_vec3(sums, MOTOR_GRADIENT + 72 + 3 * leg, by_angles)
