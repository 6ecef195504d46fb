"""Observation terms of velocity tracking: measurable terms for actor and critic, and terms for the critic alone.

Body axes are x ahead, y left, z up; paws are FL, FR, BL, BR. `set_mirror` states how a term changes if the robot is
mirrored left to right: column numbers, negative where the sign changes. Factors scale values to the order of 1.
"""

import warp as wp

from ..layout import BODIES
from ..mdp.mirror import LEGS, set_mirror
from ..mdp.view import RobotArrays, RobotView, base_pos, base_quat, rotate_yaw, yaw_of
from ..terrain.ground import Ground, surface, world_ground
from .state import POLICY_RATE, VelocityState

vec6 = wp.types.vector(length=6, dtype=wp.float32)
vec15 = wp.types.vector(length=15, dtype=wp.float32)


@wp.func
def command(robot: RobotView, state: VelocityState) -> wp.vec3:
    """Commanded velocity ahead and to the left [m/s] and yaw rate [rad/s], body axes."""
    return state.command


@wp.func
def gait_phase(robot: RobotView, state: VelocityState) -> wp.vec2:
    """Sine and cosine of the gait's phase [1], which, unlike the phase, do not jump at the end of a cycle."""
    angle = 2.0 * wp.pi * state.phase
    return wp.vec2(wp.sin(angle), wp.cos(angle))


@wp.func
def command_age(robot: RobotView, state: VelocityState) -> float:
    """Time since the last command [s], at most 2: an error right after a command is no fault."""
    return wp.min(float(state.command_steps) / POLICY_RATE, 2.0)


@wp.func
def contact_times(robot: RobotView, state: VelocityState) -> wp.vec4:
    """Contact time of each paw [s], at most 1; 0 in the air."""
    return wp.min(robot.contact_time, wp.vec4(1.0))


@wp.func
def recent_steps(robot: RobotView, state: VelocityState) -> wp.vec4:
    """Number of touchdowns of each paw in the last 0.75 s."""
    return state.recent_steps


@wp.func
def paw_heights(robot: RobotView, state: VelocityState) -> wp.vec4:
    """Height of each paw above the ground below it, in units of 0.1 m."""
    return 10.0 * robot.paw_height


@wp.func
def push(arrays: RobotArrays, ground: Ground, world: int) -> vec6:
    """Push on the base, body axes: force in units of 10 N, torque in units of 3 N m."""
    wrench = arrays.body_f[world * BODIES]
    quat = base_quat(arrays, world)
    force = 0.1 * wp.quat_rotate_inv(quat, wp.vec3(wrench[0], wrench[1], wrench[2]))
    torque = wp.quat_rotate_inv(quat, wp.vec3(wrench[3], wrench[4], wrench[5])) / 3.0
    return vec6(force[0], force[1], force[2], torque[0], torque[1], torque[2])


@wp.func
def ground_heights(arrays: RobotArrays, ground: Ground, world: int) -> vec15:
    """Height of the base above a 5 x 3 grid of ground points around it [m], less 0.35.

    Element 3 i + j is 0.25 (i - 2) m ahead (i: 0 to 4) and 0.2 (j - 1) m to the left (j: 0 to 2) in the base's heading.
    """
    here = world_ground(ground, world)
    pos = base_pos(arrays, world)
    heading = yaw_of(base_quat(arrays, world))
    heights = vec15()
    for i in range(15):
        offset = rotate_yaw(wp.vec3(0.25 * float(i / 3 - 2), 0.2 * float(i % 3 - 1), 0.0), heading)
        heights[i] = pos[2] - surface(here, pos[0] + offset[0], pos[1] + offset[1])[0] - 0.35
    return heights


set_mirror((1, -2, -3), command)
set_mirror((-1, -2), gait_phase)
set_mirror((1,), command_age)
set_mirror(LEGS, contact_times, recent_steps, paw_heights)
set_mirror((1, -2, 3, -4, 5, -6), push)
set_mirror((3, 2, 1, 6, 5, 4, 9, 8, 7, 12, 11, 10, 15, 14, 13), ground_heights)  # 5 rows of 3 across
