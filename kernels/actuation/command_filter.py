"""Motor command filter (Olsen et al., Section III): limits targets more strictly as a joint nears its limit.

The filter keeps motors away from their stops and links away from each other, for any action of the policy. It does not
change the target of a joint that is far from its limits. Angles are positive outward (lateral), and away from the leg's
other thigh (outer, inner). A quantity x (a motor angle, or the sum of a leg's two transversal angles) has limits
[lower, upper]. With margins m_u = upper - x and m_l = x - lower, and the speed floor v_0, the time to violation is

    t = min( m_u / max(x', v_0), m_l / max(-x', v_0) )

and a command c becomes, with T the horizon,

    c + w (clamp(c, lower, upper) - c),   w = clamp(1 - t / T, 0, 1)

so that a command within the limits is never changed. Two rules override w; the second has priority:

1. within a hard zone before a limit (m < zone): w = 1 if c lies toward that limit from x, 0 if away from it;
2. outside the limits: w = 1.

The result is continuous in c, x and x' except where a command that violates a limit reaches the border of a hard zone,
or where x leaves the limits on one side while c lies beyond the other.
"""

import warp as wp

from ..scalar import real, vec3
from ..state import leg_coord, leg_dof, load_motors

# [rad] two turns: commands are clamped to +- this first, so that an infinite command does not become NaN
COMMAND_BOUND = wp.constant(real(12.566370614359172))


@wp.struct
class Limits:
    """Limits of a motor angle or sum of angles, and widths of hard zones inside them, which ignore speed (0: none)."""

    lower: real  # [rad]
    upper: real  # [rad]
    lower_zone: real  # [rad] >= 0
    upper_zone: real  # [rad] >= 0


@wp.struct
class FilterParams:
    """Constants of the motor command filter, the same for all legs: angle limits, time horizon, least assumed speed."""

    lateral: Limits
    transversal: Limits  # outer and inner alike
    sum: Limits  # of outer and inner transversal angle
    horizon: real  # [s] > 0, time to violation below which the limits begin to bind
    speed_floor: real  # [rad/s] > 0, least speed assumed toward a limit


@wp.func
def limit_weight(command: real, pos: real, vel: real, limits: Limits, horizon: real, speed_floor: real) -> real:
    """Return how strongly the filter enforces the limits of a motor angle or sum of angles, from 0 (not) to 1 (fully).

    See the module for the rules. command, pos [rad], vel [rad/s] of the limited quantity; horizon [s], speed_floor
    [rad/s]: see `FilterParams`.
    """
    upper_margin = limits.upper - pos
    lower_margin = pos - limits.lower
    time_left = wp.min(upper_margin / wp.max(vel, speed_floor), lower_margin / wp.max(-vel, speed_floor))
    outside = upper_margin < real(0.0) or lower_margin < real(0.0)
    in_upper_zone = upper_margin < limits.upper_zone
    in_lower_zone = lower_margin < limits.lower_zone
    toward = (in_upper_zone and command > pos) or (in_lower_zone and command < pos)
    if outside or toward:
        return real(1.0)
    if in_upper_zone or in_lower_zone:
        return real(0.0)
    return wp.clamp(real(1.0) - time_left / horizon, real(0.0), real(1.0))


@wp.func
def limit_command(command: real, pos: real, vel: real, limits: Limits, horizon: real, speed_floor: real) -> real:
    """Return the filtered command [rad] of a motor angle or sum of angles, whose measured value and rate are pos, vel.

    pos [rad], vel [rad/s]; see `limit_weight`.
    """
    weight = limit_weight(command, pos, vel, limits, horizon, speed_floor)
    return command + weight * (wp.clamp(command, limits.lower, limits.upper) - command)


@wp.func
def filter_leg(target: vec3, pos: vec3, vel: vec3, params: FilterParams) -> vec3:
    """Return one leg's motor targets [rad] after the command filter; vectors are (lateral, outer, inner), vel [rad/s].

    The limits of each motor act first. The limits of the transversal sum then act on the sum of the two results, and
    each transversal command takes half of that correction: outer - inner, which swings the leg, stays as commanded.
    """
    t, h, v = params.transversal, params.horizon, params.speed_floor
    lateral = limit_command(wp.clamp(target[0], -COMMAND_BOUND, COMMAND_BOUND), pos[0], vel[0], params.lateral, h, v)
    outer = limit_command(wp.clamp(target[1], -COMMAND_BOUND, COMMAND_BOUND), pos[1], vel[1], t, h, v)
    inner = limit_command(wp.clamp(target[2], -COMMAND_BOUND, COMMAND_BOUND), pos[2], vel[2], t, h, v)
    total = outer + inner
    half = real(0.5) * (limit_command(total, pos[1] + pos[2], vel[1] + vel[2], params.sum, h, v) - total)
    return vec3(lateral, outer + half, inner + half)


@wp.kernel
def command_filter_kernel(
    # in
    first: int,
    raw_target: wp.array2d(dtype=real),
    joint_q: wp.array(dtype=real),
    joint_qd: wp.array(dtype=real),
    offset: wp.array2d(dtype=real),
    params: FilterParams,
    # out
    filtered_target: wp.array2d(dtype=real),
):
    """Write every leg's motor targets after the command filter; launch over (4, worlds), from world `first` on.

    raw_target, filtered_target [rad]: (12, num_worlds). joint_q, joint_qd: Newton's, flat over worlds. offset [rad],
    (12, num_worlds): reading minus true angle of each position sensor; the filter uses the reading, as on the robot.
    """
    leg, world = wp.tid()
    world += first
    lateral, outer, inner = 3 * leg, 3 * leg + 1, 3 * leg + 2
    filtered = filter_leg(
        vec3(raw_target[lateral, world], raw_target[outer, world], raw_target[inner, world]),
        load_motors(joint_q, leg_coord(world, leg))
        + vec3(offset[lateral, world], offset[outer, world], offset[inner, world]),
        load_motors(joint_qd, leg_dof(world, leg)),
        params,
    )
    filtered_target[lateral, world] = filtered[0]
    filtered_target[outer, world] = filtered[1]
    filtered_target[inner, world] = filtered[2]
