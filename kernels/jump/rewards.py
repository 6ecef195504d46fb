"""Reward terms of jumps (paper, Tables I to III): pure functions of the robot, the jump and named numbers.

Times are counted in policy steps of 1/60 s.
"""

import warp as wp

from ..mdp.rewards import phi, posture_offset, psi, square_sum
from ..mdp.view import RobotView, angle_from_level, base_deceleration
from .phase import estimated_apex, landing_error_estimate
from .state import FLIGHT, LANDED, STANCE, JumpState, commanded, goal_offset, waiting

SOON = wp.constant(18)  # policy steps: the first 0.3 s after touchdown
RECOVERED = wp.constant(30)  # policy steps: 0.5 s after touchdown


@wp.func
def patience(state: JumpState, share: float) -> float:
    """Return the weight of what pays without jumping: `share` while a commanded jump has not begun, else 1."""
    return wp.where(waiting(state), share, 1.0)


@wp.func
def just_landed(state: JumpState) -> bool:
    """Return whether the touchdown was within the last 0.3 s."""
    return state.phase == LANDED and state.phase_steps < SOON


@wp.func
def should_rest(state: JumpState) -> bool:
    """Return whether the robot should stand still: before the command, and from 0.5 s after touchdown."""
    if state.phase == LANDED:
        return state.phase_steps >= RECOVERED
    return state.phase == STANCE and not commanded(state)


# ---------------------------------------------------------------- vertical jump


@wp.func
def height_kernel(error: float, fine: float, sharp: float, wide: float) -> float:
    """Return phi_fine + 3 psi_sharp + phi_wide of a height error [m]; the last, wide one gives a slope to low jumps."""
    return phi(error, fine) + 3.0 * psi(error, sharp) + phi(error, wide)


@wp.func
def jump_height(robot: RobotView, state: JumpState, fine: float, sharp: float, wide: float) -> float:
    """Jump height: closeness of the highest base height to the goal, once, at the apex."""
    if state.at_apex == 0:
        return 0.0
    return height_kernel(state.max_height - state.goal[2], fine, sharp, wide)


@wp.func
def estimated_jump_height(robot: RobotView, state: JumpState, fine: float, sharp: float, wide: float) -> float:
    """Est jump height: the same of the ballistic estimate, in flight until the apex."""
    if state.phase != FLIGHT or state.apex_passed != 0:
        return 0.0
    return height_kernel(
        estimated_apex(robot.pos, robot.lin_vel, robot.gravity_magnitude) - state.goal[2], fine, sharp, wide
    )


@wp.func
def horizontal_velocity(robot: RobotView, state: JumpState, width: float, share: float) -> float:
    """Staying over the spot: exp(-|v_xy| / width), doubled off stance; `share` of it while a jump is due."""
    speed = wp.length(wp.vec2(robot.lin_vel[0], robot.lin_vel[1]))
    return wp.exp(-speed / width) * wp.where(state.phase == STANCE, 1.0, 2.0) * patience(state, share)


@wp.func
def orientation(robot: RobotView, state: JumpState, width: float, share: float) -> float:
    """Orientation error: phi_width of the horizontal part of projected gravity; `share` of it while a jump is due."""
    return phi(wp.length(wp.vec2(robot.projected_gravity[0], robot.projected_gravity[1])), width) * patience(
        state, share
    )


@wp.func
def angular_velocity(robot: RobotView, state: JumpState, width: float, share: float) -> float:
    """Angular velocity: phi_width(|w|); `share` of it while a jump is due."""
    return phi(wp.length(robot.ang_vel), width) * patience(state, share)


@wp.func
def joint_symmetry(robot: RobotView, state: JumpState, variance: float, lateral: float, share: float) -> float:
    """Joint symmetry: phi of the transversal angles' variance and of |lateral angles|; `share` of it while due."""
    total = float(0.0)
    total_sq = float(0.0)
    lateral_sq = float(0.0)
    for m in range(12):
        a = robot.angle[m]
        if m % 3 == 0:
            lateral_sq += a * a
        else:
            total += a
            total_sq += a * a
    spread = total_sq / 8.0 - total * total / 64.0
    return phi(spread, variance) * phi(wp.sqrt(lateral_sq), lateral) * patience(state, share)


@wp.func
def ground_posture(robot: RobotView, state: JumpState, width: float, shift: float, share: float) -> float:
    """Desired joint position on the ground: phi_width of the offset from default, transversal motors + shift.

    `share` of it while a jump is due.
    """
    if state.phase == FLIGHT:
        return 0.0
    return phi(posture_offset(robot, shift), width) * patience(state, share)


@wp.func
def air_posture(robot: RobotView, state: JumpState, width: float) -> float:
    """Desired joint position in the air: phi_width of the offset from default."""
    if state.phase != FLIGHT:
        return 0.0
    return phi(posture_offset(robot, 0.0), width)


@wp.func
def retract(robot: RobotView, state: JumpState, width: float, shift: float) -> float:
    """Retracting after landing: phi_width of the offset from default, transversal motors + shift, first 0.3 s."""
    if not just_landed(state):
        return 0.0
    return phi(posture_offset(robot, shift), width)


# ---------------------------------------------------------------- horizontal jump


@wp.func
def tracking(robot: RobotView, state: JumpState, wide: float, fine: float, fine_share: float) -> float:
    """Tracking: phi_wide + fine_share phi_fine of the distance from the goal [m], after takeoff."""
    if state.phase == STANCE:
        return 0.0
    error = wp.length(goal_offset(robot, state))
    return phi(error, wide) + fine_share * phi(error, fine)


@wp.func
def estimated_tracking(
    robot: RobotView, state: JumpState, middle: float, wide: float, fine: float, height: float
) -> float:
    """Est tracking: phi_middle + 0.1 phi_wide + 0.3 phi_fine of the ballistic landing's distance from the goal.

    In flight. The landing is where the base falls through a height [m].
    """
    if state.phase != FLIGHT:
        return 0.0
    error = landing_error_estimate(robot, state, height)
    return phi(error, middle) + 0.1 * phi(error, wide) + 0.3 * phi(error, fine)


@wp.func
def flight_orientation(robot: RobotView, state: JumpState, width: float) -> float:
    """Orientation error: phi_width of the rotation from level and heading, in flight while moving toward the goal."""
    if state.phase != FLIGHT or wp.dot(robot.lin_vel, goal_offset(robot, state)) <= 0.0:
        return 0.0
    return phi(angle_from_level(robot.quat, state.heading), width)


@wp.func
def flight_angular_velocity(robot: RobotView, state: JumpState, width: float) -> float:
    """Angular velocity: phi_width(|w|), in flight."""
    if state.phase != FLIGHT:
        return 0.0
    return phi(wp.length(robot.ang_vel), width)


@wp.func
def left_right_symmetry(robot: RobotView, state: JumpState, width: float, share: float) -> float:
    """Joint symmetry: phi_width of the rms difference of left and right transversal angles; `share` of it while due."""
    total = float(0.0)
    for m in range(12):
        if m % 3 != 0 and (m / 3) % 2 == 0:
            off = robot.angle[m] - robot.angle[m + 3]
            total += off * off
    return phi(wp.sqrt(total / 4.0), width) * patience(state, share)


@wp.func
def standing_posture(robot: RobotView, state: JumpState, width: float, shift: float) -> float:
    """Stance: phi_width of the offset from default, transversal motors + shift, while the robot should rest."""
    if not should_rest(state):
        return 0.0
    return phi(posture_offset(robot, shift), width)


# ---------------------------------------------------------------- impacts and landing


@wp.func
def soft_impact(robot: RobotView, state: JumpState, limit: float) -> float:
    """Soft impact: max(0, 1 - deceleration / limit), first 0.3 s after touchdown."""
    if not just_landed(state):
        return 0.0
    return wp.max(0.0, 1.0 + base_deceleration(robot) / limit)


@wp.func
def stance_impact(robot: RobotView, state: JumpState, limit: float) -> float:
    """Stance impact: deceleration / limit in stance, in -1..0."""
    if state.phase != STANCE:
        return 0.0
    return wp.clamp(base_deceleration(robot) / limit, -1.0, 0.0)


@wp.func
def catch_landing(robot: RobotView, state: JumpState) -> float:
    """Catch landing: let the base fall on, clamp(-v_z, 0, 1), first 0.3 s."""
    if not just_landed(state):
        return 0.0
    return wp.clamp(-robot.lin_vel[2], 0.0, 1.0)


@wp.func
def damp_landing(robot: RobotView, state: JumpState) -> float:
    """Damp landing: fold the legs, mean clamp(transversal rates, 0, 1), first 0.3 s."""
    if not just_landed(state):
        return 0.0
    total = float(0.0)
    for m in range(12):
        if m % 3 != 0:
            total += wp.clamp(robot.rate[m], 0.0, 1.0)
    return total / 8.0


@wp.func
def rest(robot: RobotView, state: JumpState, speed: float, spin: float) -> float:
    """Rest: phi_speed(|v|) phi_spin(|w|), while the robot should rest."""
    if not should_rest(state):
        return 0.0
    return phi(wp.length(robot.lin_vel), speed) * phi(wp.length(robot.ang_vel), spin)


@wp.func
def tilt_over(robot: RobotView, width: float) -> float:
    """Return the squared sine of the angle between body z and world z over that of width [rad]."""
    sine = wp.length(wp.vec2(robot.projected_gravity[0], robot.projected_gravity[1])) / wp.sin(width)
    return sine * sine


@wp.func
def landing_tilt(robot: RobotView, state: JumpState, width: float) -> float:
    """Tilt after touchdown: squared sine of the angle between body z and world z over that of width [rad]."""
    if state.phase != LANDED:
        return 0.0
    return tilt_over(robot, width)


@wp.func
def descent_tilt(robot: RobotView, state: JumpState, width: float) -> float:
    """Tilt while the base falls in flight: squared sine as in `landing_tilt`, with the same width [rad]."""
    if state.phase != FLIGHT or robot.lin_vel[2] > 0.0:
        return 0.0
    return tilt_over(robot, width)


@wp.func
def lifted_again(robot: RobotView, state: JumpState, free: float) -> float:
    """Still landing: paws off the ground again for more than `free` [s] after their own first contact, 0 to 4."""
    count = float(0.0)
    if state.phase == LANDED:
        for k in range(4):
            if (state.paws_landed >> k) & 1 == 1 and robot.contact[k] == 0.0 and robot.air_time[k] > free:
                count += 1.0
    return count


@wp.func
def paws_down(robot: RobotView, state: JumpState) -> float:
    """Still landing: paws on the ground after touchdown, 0 to 4."""
    if state.phase != LANDED:
        return 0.0
    return float(robot.contacts)


@wp.func
def capture_point(robot: RobotView, state: JumpState, width: float) -> float:
    """Bracing: phi_width of the way from the middle of the paws to where a pendulum of the base's height would stop.

    After touchdown. The pendulum that moves with the base comes to rest over p + v sqrt(h / g).
    """
    if state.phase != LANDED:
        return 0.0
    reach = wp.sqrt(wp.max(robot.height, 0.0) / robot.gravity_magnitude)
    x = robot.pos[0] + reach * robot.lin_vel[0]
    y = robot.pos[1] + reach * robot.lin_vel[1]
    for k in range(4):
        x -= 0.25 * robot.paw_pos[k, 0]
        y -= 0.25 * robot.paw_pos[k, 1]
    return phi(wp.length(wp.vec2(x, y)), width)


# ---------------------------------------------------------------- standing quietly


@wp.func
def resting_action_rate(robot: RobotView, state: JumpState) -> float:
    """Quiet actions: sum of squared changes of the action, while the robot should rest."""
    if not should_rest(state):
        return 0.0
    return square_sum(robot.action - robot.prev_action)


@wp.func
def torque_ripple(robot: RobotView, state: JumpState) -> float:
    """Torque ripple: sum of squared changes of the motor torques over the step [N^2 m^2], while it should rest."""
    if not should_rest(state):
        return 0.0
    return square_sum(robot.torque - robot.prev_torque)


@wp.func
def force_ripple(robot: RobotView, state: JumpState, weight_force: float) -> float:
    """Force ripple: sum over paws of squares of the step's peak less its last force over the weight's [N], at rest."""
    if not should_rest(state):
        return 0.0
    off = robot.peak_force - robot.paw_force
    return wp.dot(off, off) / (weight_force * weight_force)
