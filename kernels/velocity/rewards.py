"""Reward terms of velocity tracking (paper, Tables III and IV): pure functions of robot, command and numbers."""

import warp as wp

from ..mdp.rewards import phi
from ..mdp.view import RobotView
from .state import VelocityState, velocity_error


@wp.func
def moving(state: VelocityState) -> float:
    """Return 1 if the robot is commanded to move, else 0."""
    return wp.where(state.standing == 0, 1.0, 0.0)


@wp.func
def linear_velocity(robot: RobotView, state: VelocityState, width: float) -> float:
    """Linear velocity tracking: phi_width of the distance [m/s] of the velocity in the plane from the command."""
    error = velocity_error(robot, state)
    return phi(wp.length(wp.vec2(error[0], error[1])), width)


@wp.func
def yaw_rate(robot: RobotView, state: VelocityState, width: float) -> float:
    """Yaw rate tracking: phi_width of the error [rad/s]."""
    return phi(velocity_error(robot, state)[2], width)


@wp.func
def vertical_velocity(robot: RobotView, state: VelocityState) -> float:
    """Vertical velocity L2: its square [m^2/s^2], body axes."""
    up = wp.quat_rotate_inv(robot.quat, robot.lin_vel)[2]
    return up * up


@wp.func
def lateral_stability(robot: RobotView, state: VelocityState) -> float:
    """Lateral stability L2: square of the angular velocity about body x and y [rad^2/s^2]."""
    return robot.ang_vel[0] * robot.ang_vel[0] + robot.ang_vel[1] * robot.ang_vel[1]


@wp.func
def flat(robot: RobotView, state: VelocityState) -> float:
    """Flat L2: square of the horizontal part of projected gravity [1]."""
    return (
        robot.projected_gravity[0] * robot.projected_gravity[0]
        + robot.projected_gravity[1] * robot.projected_gravity[1]
    )


@wp.func
def stand(robot: RobotView, state: VelocityState, width: float) -> float:
    """Stand: phi_width of the rms offset [rad] of the transversal angles from default, when commanded to stand."""
    if state.standing == 0:
        return 0.0
    total = float(0.0)
    for m in range(12):
        if m % 3 != 0:
            off = robot.angle[m] - robot.default_angle[m]
            total += off * off
    return phi(wp.sqrt(total / 8.0), width)


@wp.func
def lateral_position(robot: RobotView, state: VelocityState, steepness: float) -> float:
    """Lateral position: sum over lateral motors of exp(-steepness offset^8) - 1, offset from default [rad]."""
    total = float(0.0)
    for m in range(12):
        if m % 3 == 0:
            square = (robot.angle[m] - robot.default_angle[m]) * (robot.angle[m] - robot.default_angle[m])
            total += wp.exp(-steepness * square * square * square * square) - 1.0
    return total


@wp.func
def transversal_position(robot: RobotView, state: VelocityState, steepness: float, shift: float) -> float:
    """Transversal position: sum over these motors of exp(-steepness offset^20) - 1, offset from default + shift."""
    total = float(0.0)
    for m in range(12):
        if m % 3 != 0:
            off = robot.angle[m] - robot.default_angle[m] - shift
            fourth = off * off * off * off
            total += wp.exp(-steepness * fourth * fourth * fourth * fourth * fourth) - 1.0
    return total


@wp.func
def air_time(robot: RobotView, state: VelocityState, least: float) -> float:
    """Air time: sum of the times in the air less `least` [s] of paws that come down, when commanded to move."""
    total = float(0.0)
    for k in range(4):
        total += robot.first_contact[k] * (robot.air_time[k] - least)
    return total * moving(state)


@wp.func
def rapid_stepping(robot: RobotView, state: VelocityState, free: float) -> float:
    """Rapid stepping: sum over paws of steps in the last 0.75 s beyond those that are free; it grows without bound."""
    total = float(0.0)
    for k in range(4):
        total += wp.max(state.recent_steps[k] - free, 0.0)
    return total


@wp.func
def restless_stand(robot: RobotView, state: VelocityState) -> float:
    """Paws off the ground when commanded to stand, 0 to 4."""
    return float(4 - robot.contacts) * (1.0 - moving(state))


@wp.func
def foot_clearance(robot: RobotView, state: VelocityState, height: float) -> float:
    """Foot clearance: sum over paws in the air of (height above ground - wanted [m])^2 times horizontal speed [m/s]."""
    total = float(0.0)
    for k in range(4):
        off = robot.paw_height[k] - height
        speed = wp.length(wp.vec2(robot.paw_vel[k, 0], robot.paw_vel[k, 1]))
        total += (1.0 - robot.contact[k]) * off * off * speed
    return total


@wp.func
def slip(robot: RobotView, state: VelocityState) -> float:
    """Slip: sum of squared horizontal speeds of paws on the ground [m^2/s^2]."""
    total = float(0.0)
    for k in range(4):
        total += robot.contact[k] * (
            robot.paw_vel[k, 0] * robot.paw_vel[k, 0] + robot.paw_vel[k, 1] * robot.paw_vel[k, 1]
        )
    return total


@wp.func
def touchdown(robot: RobotView, state: VelocityState) -> float:
    """Touchdown: sum of squared downward speeds of paws that come down [m^2/s^2]."""
    total = float(0.0)
    for k in range(4):
        total += robot.first_contact[k] * robot.touchdown_speed[k] * robot.touchdown_speed[k]
    return total


@wp.func
def jerk(robot: RobotView, state: VelocityState) -> float:
    """Jerk: number of motors whose torque changed its sign since the last policy step."""
    total = float(0.0)
    for m in range(12):
        total += wp.where(wp.sign(robot.torque[m]) != wp.sign(robot.prev_torque[m]), 1.0, 0.0)
    return total


@wp.func
def trot_schedule(robot: RobotView, state: VelocityState, duty: float) -> float:
    """Trot: share of paws that are down or up as the clock says, when commanded to move.

    FL and BR are to be down in the first `duty` of the cycle, FR and BL half a cycle later.
    """
    total = float(0.0)
    for k in range(4):
        phase = state.phase
        if k == 1 or k == 2:
            phase = phase + 0.5
        phase = phase - wp.floor(phase)
        wanted = wp.where(phase < duty, 1.0, 0.0)
        total += 0.25 * (1.0 - wp.abs(wanted - robot.contact[k]))
    return total * moving(state)


@wp.func
def shank_lean(robot: RobotView, state: VelocityState, free: float, hip: float, thigh: float, shank: float) -> float:
    """Shank lean: sum over both shanks of paws on the ground of squared angles from vertical beyond `free` [rad].

    A shank that leans far over its paw hits the edge of a step beside it. The angles are those in the leg's plane, with
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
            excess = wp.max(lean - free, 0.0)
            total += robot.contact[k] * excess * excess
    return total
