"""From gradients by motor torques to those by targets and actuation: motors, latency, command filter, backwards."""

import warp as wp

from ..actuation.command_filter import FilterParams, filter_leg
from ..actuation.motors import MotorParams, motor_torque
from ..scalar import real, vec2, vec3
from .gradients import LATENCY_GRADIENT, MOTOR_GRADIENT, Gradients, add_entry, add_filter, add_motor, add_vec3
from .rollout import Actuation, Commands, Timing, arrival, commanded, load_filter, row_vec3, store_row_vec3

wp.set_module_options({"enable_backward": False})


@wp.struct
class FilterSeeds:
    """Gradient by a leg's motor angles and rates through the filter."""

    angles: vec3
    rates: vec3


@wp.func
def add_target(gradients: Gradients, step: int, motor: int, world: int, x: real):
    """Add to the gradient by a motor's filtered target of a policy step, or by what it followed before the first."""
    if step < 0:
        gradients.before[motor, world] = gradients.before[motor, world] + x
    else:
        gradients.safe[step, motor, world] = gradients.safe[step, motor, world] + x


@wp.func
def reverse_motor(
    params: MotorParams, late: real, commands: Commands, safe: wp.array3d(dtype=real), timing: Timing, dt: real,
    step: int, motor: int, world: int, angle: real, rate: real, seed: real, place: int, sums: wp.array(dtype=real),
    gradients: Gradients,
) -> vec2:  # fmt: skip
    """Add a motor's gradients for that of its torque, `seed`; return those by its angle and rate.

    place: of the motor among those of `sums`.
    """
    arrived = arrival(step, timing.substeps, late)
    newer = commanded(safe, commands.before, arrived.newer, motor, world)
    older = newer
    target = newer
    if arrived.newer > arrived.older:
        older = commanded(safe, commands.before, arrived.older, motor, world)
        if arrived.weight != real(1.0):
            target = older + arrived.weight * (newer - older)
    by_target, by_angle, by_rate, by_motor = wp.grad(motor_torque)(target, angle, rate, params)
    add_motor(sums, place, seed, by_motor)
    add_target(gradients, arrived.newer, motor, world, seed * arrived.weight * by_target)
    if arrived.newer > arrived.older:
        add_target(gradients, arrived.older, motor, world, seed * (real(1.0) - arrived.weight) * by_target)
        add_entry(sums, LATENCY_GRADIENT, -seed * by_target * (newer - older) / dt)
    return vec2(seed * by_angle, seed * by_rate)


@wp.func
def weighed_filter(target: vec3, angles: vec3, rates: vec3, params: FilterParams, seed: vec3) -> real:
    """Return the weighed sum of a leg's filtered targets."""
    return wp.dot(seed, filter_leg(target, angles, rates, params))


@wp.func
def reverse_filter(
    commands: Commands, actuation: Actuation, step: int, leg: int, world: int, angles: vec3, rates: vec3,
    place: int, sums: wp.array(dtype=real), gradients: Gradients,
) -> FilterSeeds:  # fmt: skip
    """Carry the gradient by a leg's filtered targets on to its targets; return those by its motor angles and rates.

    place: of the leg among those of `sums`.
    """
    m = 3 * leg
    seed = row_vec3(gradients.safe, step, m, world)
    found = FilterSeeds()
    by_target = seed
    if actuation.filtered != 0:
        offset = actuation.motors.offset
        read = angles + vec3(offset[m, world], offset[m + 1, world], offset[m + 2, world])
        target = row_vec3(commands.target, step, m, world)
        by_target, by_angles, by_rates, by_params, _seed = wp.grad(weighed_filter)(
            target, read, rates, load_filter(actuation.limits, world), seed
        )
        found.angles = by_angles
        found.rates = by_rates
        add_vec3(sums, MOTOR_GRADIENT + 72 + 3 * place, by_angles)
        add_filter(sums, by_params)
    store_row_vec3(gradients.target, step, m, world, by_target)
    return found
