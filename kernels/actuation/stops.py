"""Hard stops of a leg: stops of each motor, and of the sum of outer and inner angle.

A stop is a spring with a damper on the penetration x = max(0, -gap), taken at the end of the step, that never pulls:

    torque = max(0, ke x(t + dt) + kd (x(t + dt) - x(t)) / dt).

It returns no more energy than the spring stored. With s the speed away from the stop at the end of the step that is

    0 <= torque  complementary to  s + torque / c - goal >= 0,    c = dt ke + kd,

where goal = -gap / dt outside the stop (the gap closes exactly) and -gap ke / c inside. Where a stop is pressed,
torque = c (goal - s) is linear in the rates, so that it joins the leg's inertia as damping does (`joint_forces`).

The pressed stops are found together with contact: a step is solved with a set of pressed stops, and again with
another one until the set is the one that the resulting rates require (`pressed_stops`). Most steps need one set, few
three. Friction can make sets cycle, in a violent impact on jammed legs: after `PRESS_ONLY` sets, stops are only added.

Motor angles are lateral (positive outward), outer and inner (positive away from the leg's other thigh). The sum
outer + inner is the angle between the thighs; its lower stop keeps the knees apart.
"""

import warp as wp

from ..scalar import mat33, real, vec3, vec4

# set of a leg's pressed stops: an int with two bits per row; rows 0 to 3 are lateral, outer, inner, outer + inner
LOWER_STOP = wp.constant(1)  # value of a row's two bits where the lower stop is pressed; 0: neither
UPPER_STOP = wp.constant(2)  # value where the upper stop is pressed
ROW_BITS = wp.constant(2)  # bits per row
ROW_MASK = wp.constant(3)  # mask of row 0
ROWS = wp.constant(4)
ONE_BY_ONE = wp.constant(3)  # sets tried in a step after which one stop changes at a time: no cycles without friction
PRESS_ONLY = wp.constant(8)  # sets tried after which stops are pressed and none is released
MAX_SETS = wp.constant(12)  # sets tried after which the last set is accepted
# slack of a stop's law [rad/s] for each [m/s] of the contact tolerance
SLACK = wp.constant(real(10.0))


@wp.struct
class StopParams:
    """Limits, stiffness and damping of the hard stops of one leg; vectors are lateral, outer, inner."""

    lower: vec3  # [rad]
    upper: vec3
    sum_lower: real  # [rad]
    sum_upper: real
    ke: real  # [N m/rad]
    kd: real  # [N m s/rad]


@wp.struct
class StopRates:
    """End-of-step motor rates beyond which hard stops exert torque; entries: lateral, outer, inner, outer + inner."""

    lower: vec4  # [rad/s] rate at the end of the step above which the lower stop is free
    upper: vec4  # [rad/s] rate at the end of the step below which the upper stop is free
    damping: real  # c = dt ke + kd [N m s/rad]


@wp.struct
class StopForces:
    """Implicit forces of a leg's pressed hard stops: torque [N m], and matrix [kg m^2] that they add to the inertia.

    The torque is taken at the current rates. The matrix is dt C.
    """

    torque: vec3
    inertia: mat33


@wp.func
def stop_rates(p: StopParams, angles: vec3, dt: real) -> StopRates:
    """Return the end-of-step motor rates beyond which hard stops exert torque in a step dt [s], from angles [rad].

    At the lower stop, the rate is `goal` of the module. At the upper stop it is minus `goal`, since s is then minus the
    rate.
    """
    damping = wp.max(dt * p.ke + p.kd, real(1.0e-9))
    inside = p.ke / damping
    outside = real(1.0) / dt
    fold = angles[1] + angles[2]
    below = p.lower - angles
    above = p.upper - angles
    below_fold = p.sum_lower - fold
    above_fold = p.sum_upper - fold
    stop_rates = StopRates()
    stop_rates.damping = damping
    stop_rates.lower = vec4(
        below[0] * wp.where(below[0] > real(0.0), inside, outside),
        below[1] * wp.where(below[1] > real(0.0), inside, outside),
        below[2] * wp.where(below[2] > real(0.0), inside, outside),
        below_fold * wp.where(below_fold > real(0.0), inside, outside),
    )
    stop_rates.upper = vec4(
        above[0] * wp.where(above[0] < real(0.0), inside, outside),
        above[1] * wp.where(above[1] < real(0.0), inside, outside),
        above[2] * wp.where(above[2] < real(0.0), inside, outside),
        above_fold * wp.where(above_fold < real(0.0), inside, outside),
    )
    return stop_rates


@wp.func
def beyond_stops(p: StopParams, angles: vec3) -> bool:
    """Return whether motor angles [rad] of a leg are beyond a hard stop or NaN; if not, no stop is pressed."""
    fold = angles[1] + angles[2]
    past = wp.max(p.sum_lower - fold, fold - p.sum_upper)
    for j in range(3):
        past = wp.max(past, wp.max(p.lower[j] - angles[j], angles[j] - p.upper[j]))
    return not past <= real(0.0)  # NaN too


@wp.func
def row_side(pressed: int, i: int) -> int:
    """Return which stop of angle i (lateral, outer, inner, sum) is pressed: 0 (none), LOWER_STOP or UPPER_STOP."""
    return (pressed >> (ROW_BITS * i)) & ROW_MASK


@wp.func
def pressed_stops(stop_rates: StopRates, rates: vec3, slack: real, pressed: int) -> int:
    """Return which hard stops a leg presses, as a bit set, if its motors end the step at `rates` [rad/s].

    pressed: the set with which `rates` was solved; a stop is added or removed only beyond the slack [rad/s].
    """
    rate = vec4(rates[0], rates[1], rates[2], rates[1] + rates[2])
    if pressed == 0 and not wp.max(wp.max(stop_rates.lower - rate, rate - stop_rates.upper)) > slack:
        return 0
    stops = int(0)
    for i in range(ROWS):
        side = row_side(pressed, i)
        if stop_rates.lower[i] - rate[i] > wp.where(side == LOWER_STOP, -slack, slack):
            stops += LOWER_STOP << (ROW_BITS * i)
        elif rate[i] - stop_rates.upper[i] > wp.where(side == UPPER_STOP, -slack, slack):
            stops += UPPER_STOP << (ROW_BITS * i)
    return stops


@wp.func
def revised_stops(stop_rates: StopRates, rates: vec3, slack: real, pressed: int, sets: int) -> int:
    """Return which hard stops of a leg to assume pressed in the next solution of a step, after `sets` solutions.

    The last set, `pressed`, led to `rates` [rad/s]; slack [rad/s]. After `PRESS_ONLY` sets, no stop is released, so
    that the search ends.
    """
    required = pressed_stops(stop_rates, rates, slack, pressed)
    if required == pressed or sets < PRESS_ONLY:
        return required
    stops = pressed
    for i in range(ROWS):
        if row_side(pressed, i) == 0:
            stops += required & (ROW_MASK << (ROW_BITS * i))
    return stops


@wp.func
def one_by_one(sets: int) -> bool:
    """Return whether only one hard stop per world may change in the next solution of a step, after `sets` of them.

    A change of all stops at once is faster, but the sets can cycle. Without friction, a change of one stop at a time
    cannot cycle.
    """
    return sets >= ONE_BY_ONE and sets < PRESS_ONLY


@wp.func
def change_one(pressed: int, required: int) -> int:
    """Return the set `pressed` of hard stops, made equal to `required` at the first angle where they differ."""
    for i in range(ROWS):
        bits = ROW_MASK << (ROW_BITS * i)
        if (pressed ^ required) & bits != 0:
            return (pressed & ~bits) | (required & bits)
    return pressed


@wp.func
def row_torque(stop_rates: StopRates, i: int, rate: real, pressed: int) -> real:
    """Return the torque [N m] of angle i's stop (lateral, outer, inner, sum) at a rate [rad/s]; 0 if not pressed."""
    side = row_side(pressed, i)
    if side == 0:
        return real(0.0)
    return stop_rates.damping * (wp.where(side == LOWER_STOP, stop_rates.lower[i], stop_rates.upper[i]) - rate)


@wp.func
def stop_forces(stop_rates: StopRates, rates: vec3, pressed: int, dt: real) -> StopForces:
    """Return the implicit forces of a leg's pressed hard stops; rates [rad/s]: at the start of the step dt [s].

    A pressed stop has the torque c (goal - s), linear in the rates at the end of the step: dt c joins the inertia. The
    stop of outer + inner acts on both motors alike.
    """
    forces = StopForces()
    if pressed == 0:
        return forces
    zero = real(0.0)
    both = vec3(zero, real(1.0), real(1.0))
    single = vec3(
        row_torque(stop_rates, 0, rates[0], pressed),
        row_torque(stop_rates, 1, rates[1], pressed),
        row_torque(stop_rates, 2, rates[2], pressed),
    )
    forces.torque = single + row_torque(stop_rates, 3, rates[1] + rates[2], pressed) * both
    c = dt * stop_rates.damping
    diagonal = vec3(
        wp.where(row_side(pressed, 0) != 0, c, zero),
        wp.where(row_side(pressed, 1) != 0, c, zero),
        wp.where(row_side(pressed, 2) != 0, c, zero),
    )
    forces.inertia = wp.diag(diagonal) + wp.where(row_side(pressed, 3) != 0, c, zero) * wp.outer(both, both)
    return forces
