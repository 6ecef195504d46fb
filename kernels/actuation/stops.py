"""Hard stops of a leg: of each motor, and of the sum of outer and inner angle.

A stop is a spring with a damper on the penetration x = max(0, -gap), taken at the end of the step, that never pulls:

    torque = max(0, ke x(t + dt) + kd (x(t + dt) - x(t)) / dt).

It gives back no more than the spring took. With s the speed away from the stop at the end of the step that is

    0 <= torque  complementary to  s + torque / c - goal >= 0,    c = dt ke + kd,

where goal = -gap / dt outside the stop (the gap closes exactly) and -gap ke / c inside. Where a stop is pressed,
torque = c (goal - s) is linear in the rates, so that it joins the leg's inertia as damping does (`joint_forces`).

Which stops are pressed is settled together with contact: a step is solved with a set of pressed stops, and again with
another one until the set is the one that the resulting rates ask for (`pressed_stops`).
"""

import warp as wp

from ..scalar import mat33, real, vec2, vec3

# sets of a leg: two bits for each of lateral, outer, inner, and outer + inner
LOWER_STOP = wp.constant(1)
UPPER_STOP = wp.constant(2)
ROW_BITS = wp.constant(2)
ROW_MASK = wp.constant(3)
ROWS = wp.constant(4)
# sets tried in a step, and from which on they differ in one stop only, so as not to cycle
MAX_SETS = wp.constant(12)
ONE_BY_ONE = wp.constant(3)
# slack of a stop's law [rad/s] for each [m/s] of the contact tolerance
SLACK = wp.constant(real(10.0))


@wp.struct
class StopParams:
    """The stops of one leg; vectors are lateral, outer, inner."""

    lower: vec3  # [rad]
    upper: vec3
    sum_lower: real  # [rad]
    sum_upper: real
    ke: real  # [N m/rad]
    kd: real  # [N m s/rad]


@wp.struct
class StopForces:
    """Pressed stops, implicit: torque [N m] at the current rates, and dt C [kg m^2] to add to the inertia."""

    torque: vec3
    inertia: mat33


@wp.func
def row_side(pressed: int, row: int) -> int:
    """Return which stop of a row is pressed: 0, LOWER_STOP or UPPER_STOP."""
    return (pressed >> (ROW_BITS * row)) & ROW_MASK


@wp.func
def stiffness(p: StopParams, dt: real) -> vec2:
    """Return c [N m s/rad], and ke / c [1/s], the share of a penetration that is pushed out per second."""
    c = wp.max(dt * p.ke + p.kd, real(1.0e-9))
    return vec2(c, p.ke / c)


@wp.func
def rate_at_stop(distance: real, side: int, push_out: real, dt: real) -> real:
    """Return the rate [rad/s] of an angle at which a stop's torque is zero; distance [rad]: stop minus angle."""
    inside = distance > real(0.0)
    if side == UPPER_STOP:
        inside = distance < real(0.0)
    return wp.where(inside, push_out * distance, distance / dt)


@wp.func
def pressed_row(
    angle: real, rate: real, lower: real, upper: real, push_out: real, dt: real, slack: real, side: int
) -> int:
    """Return which of two stops an angle presses that ends the step at `rate`; side: which it was solved with."""
    if rate_at_stop(lower - angle, LOWER_STOP, push_out, dt) - rate > wp.where(side == LOWER_STOP, -slack, slack):
        return LOWER_STOP
    if rate - rate_at_stop(upper - angle, UPPER_STOP, push_out, dt) > wp.where(side == UPPER_STOP, -slack, slack):
        return UPPER_STOP
    return 0


@wp.func
def pressed_stops(p: StopParams, angles: vec3, rates: vec3, dt: real, slack: real, pressed: int) -> int:
    """Return the set of stops that a leg presses which ends the step at `rates` [rad/s].

    angles [rad]: at the start of the step. pressed: the set that led to the rates; its stops are released, and others
    pressed, only beyond the slack [rad/s].
    """
    push_out = stiffness(p, dt)[1]
    found = int(0)
    for j in range(3):
        found += pressed_row(
            angles[j], rates[j], p.lower[j], p.upper[j], push_out, dt, slack, row_side(pressed, j)
        ) << (ROW_BITS * j)  # fmt: skip
    found += pressed_row(
        angles[1] + angles[2], rates[1] + rates[2], p.sum_lower, p.sum_upper, push_out, dt, slack, row_side(pressed, 3)
    ) << (ROW_BITS * 3)  # fmt: skip
    return found


@wp.func
def change_one(pressed: int, wanted: int) -> int:
    """Return `pressed` with the first row in which it differs from `wanted` changed."""
    for row in range(ROWS):
        bits = ROW_MASK << (ROW_BITS * row)
        if (pressed ^ wanted) & bits != 0:
            return (pressed & ~bits) | (wanted & bits)
    return pressed


@wp.func
def row_torque(angle: real, rate: real, lower: real, upper: real, side: int, law: vec2, dt: real) -> vec2:
    """Return torque [N m] and c [N m s/rad] of a row, zero where no stop is pressed."""
    if side == 0:
        return vec2()
    distance = wp.where(side == LOWER_STOP, lower, upper) - angle
    return vec2(law[0] * (rate_at_stop(distance, side, law[1], dt) - rate), law[0])


@wp.func
def stop_forces(p: StopParams, angles: vec3, rates: vec3, pressed: int, dt: real) -> StopForces:
    """Return the forces of a leg's pressed stops; angles [rad] and rates [rad/s] at the start of the step."""
    forces = StopForces()
    if pressed == 0:
        return forces
    law = stiffness(p, dt)
    lateral = row_torque(angles[0], rates[0], p.lower[0], p.upper[0], row_side(pressed, 0), law, dt)
    outer = row_torque(angles[1], rates[1], p.lower[1], p.upper[1], row_side(pressed, 1), law, dt)
    inner = row_torque(angles[2], rates[2], p.lower[2], p.upper[2], row_side(pressed, 2), law, dt)
    fold = row_torque(
        angles[1] + angles[2], rates[1] + rates[2], p.sum_lower, p.sum_upper, row_side(pressed, 3), law, dt
    )
    both = vec3(real(0.0), real(1.0), real(1.0))
    forces.torque = vec3(lateral[0], outer[0], inner[0]) + fold[0] * both
    forces.inertia = wp.diag(dt * vec3(lateral[1], outer[1], inner[1])) + dt * fold[1] * wp.outer(both, both)
    return forces
