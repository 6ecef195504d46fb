"""Reward terms of velocity tracking (paper, Tables II and III), as functions of robot, command and parameters.

Penalties have negative weights in the tasks, unless their values are negative. phi: Gaussian kernel of `mdp.rewards`,
exp(-(x / std)^2); std: its width, in the unit of its argument. World z is up; body axes are x ahead, y left, z up. Paws
and legs k are FL, FR, BL, BR. Motors of a leg are lateral (m % 3 = 0) and two transversal ones, outer and inner,
positive away from the leg's other thigh.
"""

import warp as wp

from ..mdp.rewards import phi, root, torque_sign_changes  # noqa: F401  (saved configurations name it here)
from ..mdp.view import RobotView
from .state import VelocityState, velocity_error


@wp.func
def moving(state: VelocityState) -> float:
    """Return 1 if the robot is commanded to move, else 0."""
    return wp.where(state.standing == 0, 1.0, 0.0)


@wp.func
def linear_velocity(robot: RobotView, state: VelocityState, std: float) -> float:
    """Reward for tracking the commanded horizontal velocity: Gaussian phi_std of the error [m/s], body axes."""
    error = velocity_error(robot, state)
    return phi(wp.length(wp.vec2(error[0], error[1])), std)


@wp.func
def yaw_rate(robot: RobotView, state: VelocityState, std: float) -> float:
    """Reward for tracking the commanded yaw rate: Gaussian phi_std of the error [rad/s]."""
    return phi(velocity_error(robot, state)[2], std)


@wp.func
def yaw_rate_on_course(robot: RobotView, state: VelocityState, std: float, std_lin_vel: float) -> float:
    """Reward for tracking the commanded yaw rate by robots that also track the commanded velocity.

    It is phi_std of the error of the yaw rate [rad/s] times phi_std_lin_vel of the horizontal velocity error [m/s].
    Without the second factor, a robot that stands still keeps its yaw rate best, and may never begin to walk.
    """
    error = velocity_error(robot, state)
    return phi(error[2], std) * phi(wp.length(wp.vec2(error[0], error[1])), std_lin_vel)


@wp.func
def lin_vel_xy_l1(robot: RobotView, state: VelocityState) -> float:
    """Penalty of the horizontal velocity error: its length [m/s], body axes. Its slope is the same at any error."""
    error = velocity_error(robot, state)
    return wp.length(wp.vec2(error[0], error[1]))


@wp.func
def lin_vel_z_l2(robot: RobotView, state: VelocityState) -> float:
    """Penalty of vertical motion of the base: its squared velocity along body z [m^2/s^2]."""
    up = wp.quat_rotate_inv(robot.quat, robot.lin_vel)[2]
    return up * up


@wp.func
def ang_vel_xy_l2(robot: RobotView, state: VelocityState) -> float:
    """Penalty of rolling and pitching: sum of squared angular velocities about body x and y [rad^2/s^2]."""
    return robot.ang_vel[0] * robot.ang_vel[0] + robot.ang_vel[1] * robot.ang_vel[1]


@wp.func
def flat_orientation_l2(robot: RobotView, state: VelocityState) -> float:
    """Penalty of the base's tilt: squared sine of the tilt (horizontal part of projected gravity) [1]."""
    return (
        robot.projected_gravity[0] * robot.projected_gravity[0]
        + robot.projected_gravity[1] * robot.projected_gravity[1]
    )


@wp.func
def standing_posture(robot: RobotView, state: VelocityState, std: float, shift: float = 0.0) -> float:
    """Reward for transversal motors near the default pose plus `shift` [rad] when commanded to stand.

    The reward is phi_std of the rms offset [rad].
    """
    if state.standing == 0:
        return 0.0
    total = float(0.0)
    for m in range(12):
        if m % 3 != 0:
            offset = robot.angle[m] - robot.default_angle[m] - shift
            total += offset * offset
    return phi(root(total / 8.0), std)


@wp.func
def lateral_position(robot: RobotView, state: VelocityState, steepness: float) -> float:
    """Penalty of lateral motors far from the default pose: 0 near it, -1 for each motor far from it.

    The penalty is the sum over them of exp(-steepness offset^8) - 1; offset from default [rad]. The high power leaves a
    range free, instead of pulling toward its middle. Values are negative, so the weight is positive.
    """
    total = float(0.0)
    for m in range(12):
        if m % 3 == 0:
            square = (robot.angle[m] - robot.default_angle[m]) * (robot.angle[m] - robot.default_angle[m])
            total += wp.exp(-steepness * square * square * square * square) - 1.0
    return total


@wp.func
def transversal_position(robot: RobotView, state: VelocityState, steepness: float, shift: float) -> float:
    """Penalty of transversal motors far from the default angle plus `shift` [rad]: 0 near it, -1 for each one far off.

    The penalty is the sum over them of exp(-steepness offset^20) - 1; offset [rad]. The high power leaves a range free,
    instead of pulling toward its middle. Values are negative, so the weight is positive.
    """
    total = float(0.0)
    for m in range(12):
        if m % 3 != 0:
            offset = robot.angle[m] - robot.default_angle[m] - shift
            fourth = offset * offset * offset * offset
            total += wp.exp(-steepness * fourth * fourth * fourth * fourth * fourth) - 1.0
    return total


@wp.func
def air_time(robot: RobotView, state: VelocityState, threshold: float) -> float:
    """Reward for long swings when commanded to move: swing duration less `threshold` [s], of paws that touch down.

    Swings shorter than the threshold cost: shuffling does not pay.
    """
    total = float(0.0)
    for k in range(4):
        total += robot.first_contact[k] * (robot.air_time[k] - threshold)
    return total * moving(state)


@wp.func
def rapid_stepping(robot: RobotView, state: VelocityState, threshold: float) -> float:
    """Penalty of rapid stepping: sum over paws of max(0, touchdowns in the last 0.75 s - threshold)."""
    total = float(0.0)
    for k in range(4):
        total += wp.max(state.recent_steps[k] - threshold, 0.0)
    return total


@wp.func
def clamped_rapid_stepping(robot: RobotView, state: VelocityState, threshold: float, limit: float) -> float:
    """Penalty of rapid stepping: sum over paws of exp(max(0, touchdowns in the last 0.75 s - threshold)) - 1.

    The sum is clamped to `limit` [1]. The paper's task uses this form. The clamp removes the slope for quick steps, so
    our tasks use `rapid_stepping`.
    """
    total = float(0.0)
    for k in range(4):
        total += wp.exp(wp.max(state.recent_steps[k] - threshold, 0.0)) - 1.0
    return wp.min(total, limit)


@wp.func
def restless_stand(robot: RobotView, state: VelocityState) -> float:
    """Penalty of lifted paws when commanded to stand: number of paws off the ground, 0 to 4."""
    return float(4 - robot.contacts) * (1.0 - moving(state))


@wp.func
def foot_clearance(robot: RobotView, state: VelocityState, target_height: float) -> float:
    """Penalty of paws that swing above or below `target_height` [m], weighted by their horizontal speed.

    The penalty is the sum over paws in the air of (height - target_height [m])^2 times horizontal speed [m/s]. A paw is
    fast in the middle of its swing, where it should be high, and slow where it lifts and lands.
    """
    total = float(0.0)
    for k in range(4):
        error = robot.paw_height[k] - target_height
        speed = wp.length(wp.vec2(robot.paw_vel[k, 0], robot.paw_vel[k, 1]))
        total += (1.0 - robot.contact[k]) * error * error * speed
    return total


@wp.func
def slip(robot: RobotView, state: VelocityState) -> float:
    """Penalty of paws that slip on the ground: sum of their squared horizontal speeds [m^2/s^2]."""
    total = float(0.0)
    for k in range(4):
        total += robot.contact[k] * (
            robot.paw_vel[k, 0] * robot.paw_vel[k, 0] + robot.paw_vel[k, 1] * robot.paw_vel[k, 1]
        )
    return total


@wp.func
def touchdown(robot: RobotView, state: VelocityState) -> float:
    """Penalty of hard touchdowns: sum over paws that touch down of squared downward speed [m^2/s^2]."""
    total = float(0.0)
    for k in range(4):
        total += robot.first_contact[k] * robot.touchdown_speed[k] * robot.touchdown_speed[k]
    return total


@wp.func
def trot_schedule(robot: RobotView, state: VelocityState, duty: float) -> float:
    """Reward for trotting in phase when commanded to move: fraction of paws whose contact fits the gait's phase.

    FL and BR should be down in the first `duty` [1] of the cycle, FR and BL half a cycle later.
    """
    total = float(0.0)
    for k in range(4):
        phase = state.phase
        if k == 1 or k == 2:
            phase = phase + 0.5
        phase = phase - wp.floor(phase)
        target = wp.where(phase < duty, 1.0, 0.0)
        total += 0.25 * (1.0 - wp.abs(target - robot.contact[k]))
    return total * moving(state)


@wp.func
def shank_lean(
    robot: RobotView, state: VelocityState, threshold: float, hip: float, thigh: float, shank: float
) -> float:
    """Penalty of shanks inclined by more than `threshold` [rad] from the vertical, in legs whose paw is on the ground.

    The penalty is the sum over both shanks of legs in contact of max(0, angle from vertical - threshold)^2 [rad^2]. A
    shank that leans far over its paw can hit the edge of an adjacent step. Angles are in the leg's plane and include
    the pitch of the base. hip: half the distance of the transversal axes [m]; thigh, shank: lengths [m].
    """
    down = wp.vec2(robot.projected_gravity[0], robot.projected_gravity[2])
    total = float(0.0)
    for k in range(4):
        front = wp.where(k < 2, 1.0, -1.0)
        outer, inner = robot.angle[3 * k + 1], robot.angle[3 * k + 2]
        knee = wp.vec2(front * (hip + thigh * wp.sin(outer)), -thigh * wp.cos(outer))
        twin = wp.vec2(-front * (hip + thigh * wp.sin(inner)), -thigh * wp.cos(inner))
        apart = wp.length(knee - twin)
        along = wp.vec2(-(knee - twin)[1], (knee - twin)[0]) * (-front / wp.max(apart, 1.0e-6))
        reach = wp.sqrt(wp.max(shank * shank - 0.25 * apart * apart, 0.0))
        ankle = 0.5 * (knee + twin) + reach * along
        for j in range(2):
            way = ankle - wp.where(j == 0, knee, twin)
            lean = wp.acos(wp.clamp(wp.dot(way, down) / (shank * wp.max(wp.length(down), 1.0e-6)), -1.0, 1.0))
            excess = wp.max(lean - threshold, 0.0)
            total += robot.contact[k] * excess * excess
    return total
