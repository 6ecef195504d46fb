"""Observation terms that any task can use: robot state, and randomised robot parameters (`drawn_*`).

`drawn_*` terms, which no sensor measures, are for the critic: they explain differences between worlds that no action
causes. Units scale them to the order of 1. Body axes are x ahead, y left, z up; motors are 3 * leg + j, legs FL, FR,
BL, BR, j lateral, outer, inner. `set_mirror` states how a term changes if the robot is mirrored left to right.
"""

from typing import Any

import warp as wp

from .mirror import FRONT_BACK_MOTORS, LEGS, MOTORS, ROTATION, VECTOR, set_mirror
from .parameters import RobotParameters, nominal_column
from .view import RobotView, vec12

vec6 = wp.types.vector(length=6, dtype=wp.float32)


@wp.func
def lin_vel(robot: RobotView, state: Any) -> wp.vec3:
    """Velocity of the base origin [m/s], body axes."""
    return wp.quat_rotate_inv(robot.quat, robot.lin_vel)


@wp.func
def ang_vel(robot: RobotView, state: Any) -> wp.vec3:
    """Angular velocity of the base [rad/s], body axes."""
    return robot.ang_vel


@wp.func
def gravity(robot: RobotView, state: Any) -> wp.vec3:
    """Unit vector of gravity, body axes [1]; (0, 0, -1) when level."""
    return robot.projected_gravity


@wp.func
def height(robot: RobotView, state: Any) -> float:
    """Height of the base origin above the ground below it [m]."""
    return robot.height


@wp.func
def angle(robot: RobotView, state: Any) -> vec12:
    """Motor angles with the errors of the position sensors, less the angles of the default pose [rad]."""
    return robot.sensed_angle - robot.default_angle


@wp.func
def rate(robot: RobotView, state: Any) -> vec12:
    """Motor rates [rad/s]."""
    return robot.rate


@wp.func
def last_action(robot: RobotView, state: Any) -> vec12:
    """Action of the previous policy step, clamped to -1..1 [1]."""
    return robot.action


@wp.func
def paw_forces(robot: RobotView, state: Any) -> wp.vec4:
    """Force on each paw in units of the robot's weight (140 N), at most 5 [1]."""
    force = wp.vec4(0.0)
    for k in range(4):
        force[k] = wp.min(robot.paw_force[k] / 140.0, 5.0)
    return force


@wp.func
def air_times(robot: RobotView, state: Any) -> wp.vec4:
    """Air time of each paw [s]: at its first contact the duration of the swing, afterwards 0."""
    return robot.air_time


@wp.func
def contacts(robot: RobotView, state: Any) -> wp.vec4:
    """Contact flag of each paw: 1 on the ground, else 0."""
    return robot.contact


@wp.func
def drawn_mass(robot: RobotParameters, world: int) -> wp.vec2:
    """Mass added to the base, and to all legs together [kg]."""
    first = world * 21
    nominal = first % robot.nominal_mass.shape[0]
    legs = float(0.0)
    for body in range(1, 21):
        legs += robot.body_mass[first + body] - robot.nominal_mass[nominal + body]
    return wp.vec2(robot.body_mass[first] - robot.nominal_mass[nominal], legs)


@wp.func
def drawn_com(robot: RobotParameters, world: int) -> wp.vec3:
    """Shift of the base's centre of mass, body axes, in units of 0.03 m."""
    i = world * 21
    return (robot.body_com[i] - robot.nominal_com[i % robot.nominal_com.shape[0]]) / 0.03


@wp.func
def drawn_gains(robot: RobotParameters, world: int) -> vec12:
    """Relative change of kp of each motor from the active skill's value [1]."""
    change = vec12()
    for m in range(12):
        change[m] = robot.gain_ratio[m, world][0] - 1.0
    return change


@wp.func
def drawn_speed_limits(robot: RobotParameters, world: int) -> vec12:
    """Relative change of the no-load speed of each motor from the active skill's value [1]."""
    change = vec12()
    for m in range(12):
        nominal = robot.nominal_no_load[robot.skill[world], nominal_column(robot, world, m)]
        change[m] = robot.motors.no_load_speed[m, world] / nominal - 1.0
    return change


@wp.func
def drawn_latency(robot: RobotParameters, world: int) -> float:
    """Latency of actions in units of 8 physics steps [1]."""
    return float(robot.latency[world]) / 8.0


@wp.func
def drawn_friction(robot: RobotParameters, world: int) -> wp.vec2:
    """Dynamic friction coefficient less 0.85 in units of 0.1, and static over dynamic coefficient less 1."""
    dynamic = robot.shape_mu[robot.paw_shapes[4 * world]]
    return wp.vec2((dynamic - 0.85) * 10.0, robot.static_ratio[world] - 1.0)


@wp.func
def drawn_offset(robot: RobotParameters, world: int) -> vec12:
    """Constant error of each motor's position sensor in units of 0.035 rad (2 degrees)."""
    error = vec12()
    for m in range(12):
        error[m] = robot.motors.offset[m, world] / 0.035
    return error


@wp.func
def drawn_push(robot: RobotParameters, world: int) -> vec6:
    """Push on the base, world axes: force in units of 5 N, torque in units of 3 N m."""
    wrench = robot.push[world]
    return vec6(wrench[0] / 5.0, wrench[1] / 5.0, wrench[2] / 5.0, wrench[3] / 3.0, wrench[4] / 3.0, wrench[5] / 3.0)


set_mirror((1,), height, drawn_latency, front_back=(1,))
set_mirror((1, 2), drawn_mass, drawn_friction)
set_mirror(VECTOR, lin_vel, gravity, drawn_com, front_back=(-1, 2, 3))
set_mirror(ROTATION, ang_vel, front_back=(1, -2, -3))
set_mirror(LEGS, paw_forces, air_times, contacts)
set_mirror(MOTORS, angle, rate, last_action, front_back=FRONT_BACK_MOTORS)
set_mirror(MOTORS, drawn_gains, drawn_speed_limits, drawn_offset)
