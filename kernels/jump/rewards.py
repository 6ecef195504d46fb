"""Reward terms of jumps (paper, Tables II and IV), as functions of the robot's state, the jump's state and parameters.

Penalties have negative weights in the tasks, unless their values are negative. Times are counted in policy steps of
1/60 s. phi, psi: Gaussian and Laplacian kernels of `mdp.rewards`, exp(-(x / std)^2) and exp(-|x| / scale); std_* and
scale_*: their widths, in the unit of their argument. shift [rad]: added to the default angles of transversal motors; a
positive one moves the thighs apart, which lowers the base. waiting_scale [1]: factor, from the command to the takeoff,
on rewards that need no jump: standing pays less while a jump is due.

World z is up. Motors of a leg are lateral (m % 3 = 0; positive outward) and two transversal ones (positive away from
the leg's other thigh). Terms after touchdown teach landings in which the base comes to rest over planted paws. Wide
kernels give bad jumps a slope, narrow ones make good jumps exact. A ballistic apex or landing is where the base would
go without further forces: it rewards a good takeoff at once.
"""

import warp as wp

from ..mdp.rewards import phi, posture_offset, psi, root, square_sum
from ..mdp.view import RobotView, angle_from_level, base_deceleration
from .phase import estimated_apex, landing_error_estimate
from .state import FLIGHT, LANDED, STANCE, JumpState, commanded, goal_offset, waiting, wanted_squat

JUST_LANDED_STEPS = wp.constant(18)  # policy steps (0.3 s) after touchdown that count as just landed
REST_STEPS = wp.constant(30)  # policy steps (0.5 s) after touchdown from which on the robot should rest


@wp.func
def waiting_weight(state: JumpState, waiting_scale: float) -> float:
    """Return the factor on rewards that need no jump: `waiting_scale` between command and takeoff, else 1."""
    return wp.where(waiting(state), waiting_scale, 1.0)


@wp.func
def just_landed(state: JumpState) -> bool:
    """Return whether the touchdown was within the last 0.3 s."""
    return state.phase == LANDED and state.phase_steps < JUST_LANDED_STEPS


@wp.func
def should_rest(state: JumpState) -> bool:
    """Return whether the robot should stand still: before the jump's command, and from 0.5 s after touchdown.

    Between these times it must move, to jump or to absorb the landing.
    """
    if state.phase == LANDED:
        return state.phase_steps >= REST_STEPS
    return state.phase == STANCE and not commanded(state)


@wp.func
def height_closeness(error: float, std_fine: float, scale_sharp: float, std_wide: float) -> float:
    """Return the reward for a height error [m]: sum of a fine Gaussian, 3 times a Laplacian, and a wide Gaussian.

    The reward is phi_fine + 3 psi_sharp + phi_wide of the error; phi_wide gives low jumps a gradient.
    """
    return phi(error, std_fine) + 3.0 * psi(error, scale_sharp) + phi(error, std_wide)


@wp.func
def jump_height(robot: RobotView, state: JumpState, std_fine: float, scale_sharp: float, std_wide: float) -> float:
    """Reward for a jump whose highest base height is close to the commanded one, given once, at the apex.

    The reward is phi_fine + 3 psi_sharp + phi_wide of their difference [m].
    """
    if state.at_apex == 0:
        return 0.0
    return height_closeness(state.max_height - state.goal[2], std_fine, scale_sharp, std_wide)


@wp.func
def squat(
    robot: RobotView, state: JumpState, std: float, takeoff_height: float, acceleration: float, floor: float
) -> float:
    """Reward for a squat as deep as the commanded height needs, given once, at the apex.

    The reward is phi_std of the difference [m] between the lowest base height before takeoff and `wanted_squat`.
    """
    if state.at_apex == 0:
        return 0.0
    return phi(state.squat - wanted_squat(robot, state, takeoff_height, acceleration, floor), std)


@wp.func
def estimated_jump_height(
    robot: RobotView, state: JumpState, std_fine: float, scale_sharp: float, std_wide: float
) -> float:
    """Reward for a ballistic apex of the base close to the commanded height, in flight before the apex.

    The reward is phi_fine + 3 psi_sharp + phi_wide of their difference [m]. The ballistic apex is z + v_z^2 / 2g, or z
    if the base falls.
    """
    if state.phase != FLIGHT or state.apex_passed != 0:
        return 0.0
    return height_closeness(
        estimated_apex(robot.pos, robot.lin_vel, robot.gravity_magnitude) - state.goal[2],
        std_fine,
        scale_sharp,
        std_wide,
    )


@wp.func
def horizontal_velocity(robot: RobotView, state: JumpState, speed_scale: float, waiting_scale: float) -> float:
    """Reward for little horizontal base speed: exp(-|v_xy| / speed_scale [m/s]), doubled after takeoff.

    From the command to the takeoff it is multiplied by `waiting_scale` [1].
    """
    speed = wp.length(wp.vec2(robot.lin_vel[0], robot.lin_vel[1]))
    return (
        wp.exp(-speed / speed_scale) * wp.where(state.phase == STANCE, 1.0, 2.0) * waiting_weight(state, waiting_scale)
    )


@wp.func
def orientation(robot: RobotView, state: JumpState, std: float, waiting_scale: float) -> float:
    """Reward for a level base: Gaussian phi_std of the sine of the tilt [1] (horizontal part of projected gravity).

    From the command to the takeoff it is multiplied by `waiting_scale` [1].
    """
    return phi(wp.length(wp.vec2(robot.projected_gravity[0], robot.projected_gravity[1])), std) * waiting_weight(
        state, waiting_scale
    )


@wp.func
def angular_velocity(robot: RobotView, state: JumpState, std: float, waiting_scale: float) -> float:
    """Reward for a base that does not rotate: Gaussian phi_std of its angular speed [rad/s].

    From the command to the takeoff it is multiplied by `waiting_scale` [1].
    """
    return phi(wp.length(robot.ang_vel), std) * waiting_weight(state, waiting_scale)


@wp.func
def joint_symmetry(
    robot: RobotView, state: JumpState, std_variance: float, std_lateral: float, waiting_scale: float
) -> float:
    """Reward for equal transversal motor angles in all legs, and lateral angles close to 0.

    The reward is phi(variance of transversal angles [rad^2]) times phi(norm of lateral angles [rad]). From the command
    to the takeoff it is multiplied by `waiting_scale` [1].
    """
    total = float(0.0)
    total_sq = float(0.0)
    lateral_sq = float(0.0)
    for m in range(12):
        angle = robot.angle[m]
        if m % 3 == 0:
            lateral_sq += angle * angle
        else:
            total += angle
            total_sq += angle * angle
    variance = total_sq / 8.0 - total * total / 64.0
    return phi(variance, std_variance) * phi(root(lateral_sq), std_lateral) * waiting_weight(state, waiting_scale)


@wp.func
def ground_posture(robot: RobotView, state: JumpState, std: float, shift: float, waiting_scale: float) -> float:
    """Reward in stance and after touchdown for motor angles near the default pose plus `shift` on transversal angles.

    The reward is phi_std of the rms motor offset [rad] from that pose, multiplied by `waiting_scale` [1] from the
    command to the takeoff.
    """
    if state.phase == FLIGHT:
        return 0.0
    return phi(posture_offset(robot, shift), std) * waiting_weight(state, waiting_scale)


@wp.func
def air_posture(robot: RobotView, state: JumpState, std: float) -> float:
    """Reward for motor angles near the default pose in flight: Gaussian phi_std of the rms motor offset [rad]."""
    if state.phase != FLIGHT:
        return 0.0
    return phi(posture_offset(robot, 0.0), std)


@wp.func
def post_landing_posture(robot: RobotView, state: JumpState, std: float, shift: float) -> float:
    """Reward for motor angles near the retracted pose in the 0.3 s after touchdown.

    The pose is the default one, its transversal angles shifted by `shift` [rad]. The reward is phi_std of the rms motor
    offset [rad] from that pose.
    """
    if not just_landed(state):
        return 0.0
    return phi(posture_offset(robot, shift), std)


@wp.func
def tracking(robot: RobotView, state: JumpState, std_wide: float, std_fine: float, fine_weight: float) -> float:
    """Reward for a base close to the goal after takeoff, horizontally.

    The reward is phi_wide + fine_weight phi_fine of the distance [m].
    """
    if state.phase == STANCE:
        return 0.0
    error = wp.length(goal_offset(robot, state))
    return phi(error, std_wide) + fine_weight * phi(error, std_fine)


@wp.func
def touchdown_tracking(robot: RobotView, state: JumpState, std: float) -> float:
    """Reward for a base close to the goal at touchdown, horizontally, given once: phi_std of the distance [m]."""
    if state.touched_down == 0:
        return 0.0
    return phi(wp.length(goal_offset(robot, state)), std)


@wp.func
def estimated_tracking(
    robot: RobotView, state: JumpState, std_middle: float, std_wide: float, std_fine: float, height: float
) -> float:
    """Reward for a ballistic landing of the base close to the goal, in flight.

    The reward is phi_middle + 0.1 phi_wide + 0.3 phi_fine of their distance [m]. The ballistic landing is p_xy + t v_xy
    with t = (v_z + sqrt(v_z^2 + 2g (z - h))) / g, where the base falls through h, `height` [m] above the goal's ground.
    """
    if state.phase != FLIGHT:
        return 0.0
    error = landing_error_estimate(robot, state, height)
    return phi(error, std_middle) + 0.1 * phi(error, std_wide) + 0.3 * phi(error, std_fine)


@wp.func
def flight_orientation(robot: RobotView, state: JumpState, std: float) -> float:
    """Reward for a level base with the jump's heading, in flight while the base moves toward the goal.

    The reward is phi_std of the rotation angle [rad] from that orientation.
    """
    if state.phase != FLIGHT or wp.dot(robot.lin_vel, goal_offset(robot, state)) <= 0.0:
        return 0.0
    return phi(angle_from_level(robot.quat, state.heading), std)


@wp.func
def flight_angular_velocity(robot: RobotView, state: JumpState, std: float) -> float:
    """Reward for a base that does not rotate in flight: Gaussian phi_std of its angular speed [rad/s]."""
    if state.phase != FLIGHT:
        return 0.0
    return phi(wp.length(robot.ang_vel), std)


@wp.func
def left_right_symmetry(robot: RobotView, state: JumpState, std: float, waiting_scale: float) -> float:
    """Reward for equal transversal motor angles left and right: Gaussian phi_std of the rms difference [rad].

    From the command to the takeoff it is multiplied by `waiting_scale` [1].
    """
    total = float(0.0)
    for m in range(12):
        if m % 3 != 0 and (m / 3) % 2 == 0:  # transversal motors of left legs; the right leg is 3 motors later
            difference = robot.angle[m] - robot.angle[m + 3]
            total += difference * difference
    return phi(root(total / 4.0), std) * waiting_weight(state, waiting_scale)


@wp.func
def standing_posture(robot: RobotView, state: JumpState, std: float, shift: float) -> float:
    """Reward for motor angles near the standing pose while the robot should rest.

    The pose is the default one, its transversal angles shifted by `shift` [rad]. The reward is phi_std of the rms motor
    offset [rad].
    """
    if not should_rest(state):
        return 0.0
    return phi(posture_offset(robot, shift), std)


@wp.func
def soft_impact(robot: RobotView, state: JumpState, limit: float) -> float:
    """Reward for a soft impact, for 0.3 s from touchdown: max(0, 1 - base deceleration / limit [m/s^2]).

    It is 1 without deceleration, and 0 from the limit on.
    """
    if not just_landed(state):
        return 0.0
    return wp.max(0.0, 1.0 + base_deceleration(robot) / limit)  # base_deceleration is <= 0: minus the deceleration


@wp.func
def stance_impact(robot: RobotView, state: JumpState, limit: float) -> float:
    """Penalty of decelerating the base in stance: minus deceleration / limit [m/s^2], clamped to -1..0.

    The value is negative, so its weight is positive. `base_deceleration` is minus the deceleration, <= 0. The term
    keeps a squat from ending abruptly.
    """
    if state.phase != STANCE:
        return 0.0
    return wp.clamp(base_deceleration(robot) / limit, -1.0, 0.0)


@wp.func
def catch_landing(robot: RobotView, state: JumpState) -> float:
    """Reward for a base that still moves down, for 0.3 s from touchdown: downward speed [m/s], clamped to 0..1.

    The legs yield to the landing instead of stopping it.
    """
    if not just_landed(state):
        return 0.0
    return wp.clamp(-robot.lin_vel[2], 0.0, 1.0)


@wp.func
def damp_landing(robot: RobotView, state: JumpState) -> float:
    """Reward for legs that fold in the 0.3 s after touchdown: mean rate [rad/s] of the transversal motors.

    Each rate is clamped to 0..1: thighs that move apart (positive) lower the base.
    """
    if not just_landed(state):
        return 0.0
    total = float(0.0)
    for m in range(12):
        if m % 3 != 0:
            total += wp.clamp(robot.rate[m], 0.0, 1.0)
    return total / 8.0


@wp.func
def base_at_rest(robot: RobotView, state: JumpState, std_lin_vel: float, std_ang_vel: float) -> float:
    """Reward for a motionless base while the robot should rest.

    The reward is phi(speed [m/s]) times phi(angular speed [rad/s]).
    """
    if not should_rest(state):
        return 0.0
    return phi(wp.length(robot.lin_vel), std_lin_vel) * phi(wp.length(robot.ang_vel), std_ang_vel)


@wp.func
def settled(robot: RobotView, state: JumpState, first: float, last: float, std: float) -> float:
    """Reward for a slow base between two times after touchdown, `first` and `last` policy steps: phi of speed [m/s]."""
    steps = float(state.phase_steps)
    if state.phase != LANDED or steps < first or steps >= last:
        return 0.0
    return phi(wp.length(robot.lin_vel), std)


@wp.func
def tilt_over(robot: RobotView, angle: float) -> float:
    """Return the base's squared tilt relative to a reference tilt `angle` [rad]: (sin(tilt) / sin(angle))^2."""
    sine = wp.length(wp.vec2(robot.projected_gravity[0], robot.projected_gravity[1])) / wp.sin(angle)
    return sine * sine


@wp.func
def landing_tilt(robot: RobotView, state: JumpState, angle: float) -> float:
    """Penalty of the base's tilt after touchdown: (sin(tilt) / sin(angle))^2; angle [rad]."""
    if state.phase != LANDED:
        return 0.0
    return tilt_over(robot, angle)


@wp.func
def descent_tilt(robot: RobotView, state: JumpState, angle: float) -> float:
    """Penalty of the base's tilt while it falls in flight: (sin(tilt) / sin(angle))^2; angle [rad].

    The base must be level before it lands; at takeoff it may pitch.
    """
    if state.phase != FLIGHT or robot.lin_vel[2] > 0.0:
        return 0.0
    return tilt_over(robot, angle)


@wp.func
def lifted_again(robot: RobotView, state: JumpState, threshold: float) -> float:
    """Penalty of paws that leave the ground again after landing: number in the air for more than `threshold` [s]."""
    count = float(0.0)
    if state.phase == LANDED:
        for k in range(4):
            if (state.paws_landed >> k) & 1 == 1 and robot.contact[k] == 0.0 and robot.air_time[k] > threshold:
                count += 1.0
    return count


@wp.func
def paws_down(robot: RobotView, state: JumpState) -> float:
    """Reward for paws on the ground after touchdown: their number, 0 to 4. It discourages steps and hops."""
    if state.phase != LANDED:
        return 0.0
    return float(robot.contacts)


@wp.func
def capture_point(robot: RobotView, state: JumpState, std: float) -> float:
    """Reward after touchdown for a capture point (where an inverted pendulum stops) near the middle of the paws.

    The reward is phi_std of their horizontal distance [m]. The capture point is p + v sqrt(h / g), with the base's
    position p, velocity v and height h. A robot whose capture point is between its paws comes to rest without another
    step.
    """
    if state.phase != LANDED:
        return 0.0
    time = wp.sqrt(wp.max(robot.height, 0.0) / robot.gravity_magnitude)
    x = robot.pos[0] + time * robot.lin_vel[0]
    y = robot.pos[1] + time * robot.lin_vel[1]
    for k in range(4):
        x -= 0.25 * robot.paw_pos[k, 0]
        y -= 0.25 * robot.paw_pos[k, 1]
    return phi(wp.length(wp.vec2(x, y)), std)


@wp.func
def resting_action_rate(robot: RobotView, state: JumpState) -> float:
    """Penalty of changes of the action while the robot should rest: sum of their squares in a policy step [1]."""
    if not should_rest(state):
        return 0.0
    return square_sum(robot.action - robot.prev_action)


@wp.func
def torque_ripple(robot: RobotView, state: JumpState) -> float:
    """Penalty of changes of motor torque while the robot should rest: sum of their squares [N^2 m^2].

    The change is from the last physics step of one policy step to the last physics step of the next. The base can rest
    while motors chatter; this term makes them quiet.
    """
    if not should_rest(state):
        return 0.0
    return square_sum(robot.torque - robot.prev_torque)


@wp.func
def force_ripple(robot: RobotView, state: JumpState, weight_force: float) -> float:
    """Penalty of paw forces that vary within a policy step while the robot should rest.

    The penalty is the sum over paws of ((largest force - force in the last physics step) / weight_force [N])^2;
    weight_force is the robot's weight. The term penalises contact that chatters within a policy step.
    """
    if not should_rest(state):
        return 0.0
    excess = robot.peak_force - robot.paw_force
    return wp.dot(excess, excess) / (weight_force * weight_force)
