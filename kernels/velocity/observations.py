"""Observation terms of velocity tracking, for the policy and, of what only a simulation knows, for the critic."""

import warp as wp

from ..layout import BODIES
from ..mdp.view import RobotArrays, RobotView, base_pos, base_quat, rotate_yaw, yaw_of
from ..terrain.ground import Ground, surface, world_ground
from .state import POLICY_RATE, VelocityState

vec6 = wp.types.vector(length=6, dtype=wp.float32)
vec15 = wp.types.vector(length=15, dtype=wp.float32)


@wp.func
def command(robot: RobotView, state: VelocityState) -> wp.vec3:
    """Wanted velocity ahead and to the left [m/s] and yaw rate [rad/s], body axes."""
    return state.command


@wp.func
def step_count(robot: RobotView, state: VelocityState) -> wp.vec2:
    """Sine and cosine of the gait's phase."""
    angle = 2.0 * wp.pi * state.phase
    return wp.vec2(wp.sin(angle), wp.cos(angle))


@wp.func
def command_age(robot: RobotView, state: VelocityState) -> float:
    """Time since the command, at most 2 s."""
    return wp.min(float(state.command_steps) / POLICY_RATE, 2.0)


@wp.func
def contact_times(robot: RobotView, state: VelocityState) -> wp.vec4:
    """Time that each paw has been on the ground, at most 1 s."""
    return wp.min(robot.contact_time, wp.vec4(1.0))


@wp.func
def recent_steps(robot: RobotView, state: VelocityState) -> wp.vec4:
    """How often each paw came down in the last 0.75 s."""
    return state.recent_steps


@wp.func
def paw_heights(robot: RobotView, state: VelocityState) -> wp.vec4:
    """Height of each paw above the ground below it [m], times ten."""
    return 10.0 * robot.paw_height


@wp.func
def push(arrays: RobotArrays, ground: Ground, world: int) -> vec6:
    """Push on the base, body axes, over 10 N and 3 N m."""
    wrench = arrays.body_f[world * BODIES]
    quat = base_quat(arrays, world)
    force = 0.1 * wp.quat_rotate_inv(quat, wp.vec3(wrench[0], wrench[1], wrench[2]))
    torque = wp.quat_rotate_inv(quat, wp.vec3(wrench[3], wrench[4], wrench[5])) / 3.0
    return vec6(force[0], force[1], force[2], torque[0], torque[1], torque[2])


@wp.func
def ground_heights(arrays: RobotArrays, ground: Ground, world: int) -> vec15:
    """Height of the base above the ground around it [m], less 0.35: 5 rows from back to front, 3 from right to left."""
    here = world_ground(ground, world)
    pos = base_pos(arrays, world)
    heading = yaw_of(base_quat(arrays, world))
    found = vec15()
    for i in range(15):
        way = rotate_yaw(wp.vec3(0.25 * float(i / 3 - 2), 0.2 * float(i % 3 - 1), 0.0), heading)
        found[i] = pos[2] - surface(here, pos[0] + way[0], pos[1] + way[1])[0] - 0.35
    return found
