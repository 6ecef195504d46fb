"""Observation terms of jumps: measurable terms for actor and critic, and terms for the critic alone.

Horizontal vectors are in heading axes (ahead, to the left), so that a jump looks the same in every direction. World z
is up. `state.goal` is (x, y of the landing, base height at the apex), world. A critic with more information, such as
the jump's phase, learns faster. `set_mirror` states how a term changes if the robot is mirrored left to right: column
numbers, negative where the sign changes. Distances to a block are clamped to +-`SIGHT_RANGE`. So
the network's input stays bounded.
"""

import warp as wp

from ..mdp.mirror import set_mirror
from ..mdp.view import RobotArrays, RobotView, base_pos, base_quat, rotate_yaw, yaw_of
from ..terrain.ground import Block, Ground, floor_surface, world_ground
from .phase import estimated_apex, estimated_landing
from .state import JumpState, commanded, goal_offset

SIGHT_RANGE = wp.constant(2.0)  # [m] largest distance ahead or behind at which a block is observed
vec7 = wp.types.vector(length=7, dtype=wp.float32)
LANDING_HEIGHT = wp.constant(0.3)  # [m] of the base above the ground at the goal, at the ballistic landing


@wp.func
def wanted_height(robot: RobotView, state: JumpState) -> float:
    """Commanded height of the base at the apex [m], world z."""
    return state.goal[2]


@wp.func
def jump_command(robot: RobotView, state: JumpState) -> float:
    """Flag of a commanded jump (the paper's c): 1 from the command until touchdown, else 0."""
    return wp.where(commanded(state), 1.0, 0.0)


@wp.func
def goal(robot: RobotView, state: JumpState) -> wp.vec2:
    """Horizontal vector from base to goal [m], ahead and to the left in the base's heading; 0 before the command.

    Since the goal is hidden before the command, robots wait for it.
    """
    offset = wp.vec3(0.0)
    if state.steps >= state.command_step:
        offset = rotate_yaw(goal_offset(robot, state), -yaw_of(robot.quat))
    return wp.vec2(offset[0], offset[1])


@wp.func
def phase(robot: RobotView, state: JumpState) -> wp.vec3:
    """Phase of the jump as a one-hot vector: stance, flight, landed. For the critic: rewards depend on the phase."""
    return wp.vec3(
        wp.where(state.phase == 0, 1.0, 0.0), wp.where(state.phase == 1, 1.0, 0.0), wp.where(state.phase == 2, 1.0, 0.0)
    )


@wp.func
def phase_times(robot: RobotView, state: JumpState) -> wp.vec2:
    """Time since the phase of the jump began (at most 2 s) and time since the command (clamped to -1..3 s)."""
    return wp.vec2(
        wp.min(float(state.phase_steps), 120.0) / 60.0,
        wp.clamp(float(state.steps - state.command_step), -60.0, 180.0) / 60.0,
    )


@wp.func
def height_errors(robot: RobotView, state: JumpState) -> wp.vec2:
    """Errors [m] of the jump's highest base height so far and of the predicted apex, both less the commanded apex.

    The predicted apex is the ballistic one, z + v_z^2 / 2g, or z if the base falls.
    """
    apex = estimated_apex(robot.pos, robot.lin_vel, robot.gravity_magnitude)
    return wp.vec2(state.max_height - state.goal[2], apex - state.goal[2])


@wp.func
def landing_miss(robot: RobotView, state: JumpState) -> wp.vec2:
    """Horizontal vector from the predicted landing to the goal [m], ahead and to the left in the base's heading.

    The predicted landing is the ballistic one, p_xy + t v_xy with t = (v_z + sqrt(v_z^2 + 2g (z - h))) / g, where the
    base falls through h, 0.3 m above the goal's ground.
    """
    landing = estimated_landing(robot.pos, robot.lin_vel, LANDING_HEIGHT + state.goal_ground, robot.gravity_magnitude)
    miss = rotate_yaw(wp.vec3(state.goal[0] - landing[0], state.goal[1] - landing[1], 0.0), -yaw_of(robot.quat))
    return wp.vec2(miss[0], miss[1])


@wp.func
def way(robot: RobotView, state: JumpState) -> wp.vec2:
    """Horizontal vector from base to goal [m], ahead and to the left in the base's heading, in every phase.

    Unlike `goal` it is known before the command.
    """
    offset = rotate_yaw(goal_offset(robot, state), -yaw_of(robot.quat))
    return wp.vec2(offset[0], offset[1])


@wp.func
def span_of_ray(offset: float, half: float, direction: float) -> wp.vec2:
    """Return the distances [m] at which a horizontal ray enters and leaves the space between two parallel walls.

    The walls are normal to world x or y. offset [m]: their middle less the ray's origin, along that axis; half [m]:
    half their distance; direction: the ray's component along the axis [1]. A ray parallel to the walls gives
    (-1e6, 1e6) between them, (1e6, -1e6) outside.
    """
    if wp.abs(direction) < 1.0e-6:
        return wp.where(wp.abs(offset) <= half, wp.vec2(-1.0e6, 1.0e6), wp.vec2(1.0e6, -1.0e6))
    near = (offset - half) / direction
    far = (offset + half) / direction
    return wp.vec2(wp.min(near, far), wp.max(near, far))


@wp.func
def edges_of_block(block: Block, from_x: float, from_y: float, heading: float) -> wp.vec2:
    """Return the distances [m] at which a line from (from_x, from_y) [m] at `heading` [rad] enters and leaves a block.

    Negative distances are behind the point.
    Both are clamped to +-SIGHT_RANGE, and are SIGHT_RANGE if the ray misses the block or there is none.
    """
    along_x = span_of_ray(float(block.center[0]) - from_x, float(block.half[0]), wp.cos(heading))
    along_y = span_of_ray(float(block.center[1]) - from_y, float(block.half[1]), wp.sin(heading))
    enter = wp.max(along_x[0], along_y[0])
    leave = wp.min(along_x[1], along_y[1])
    if block.exists == 0 or enter >= leave or enter > SIGHT_RANGE:
        return wp.vec2(SIGHT_RANGE, SIGHT_RANGE)
    return wp.vec2(wp.max(enter, -SIGHT_RANGE), wp.clamp(leave, -SIGHT_RANGE, SIGHT_RANGE))


@wp.func
def block_ahead(arrays: RobotArrays, ground: Ground, world: int) -> vec7:
    """Distances [m] at which three rays ahead enter and leave the block, and the block's height above the floor [m].

    The rays are horizontal, along the base's heading, from 0.2 m to its left, the base, and 0.2 m to its right. A ray
    that misses gives 2 m twice; the height is 0 without a block.
    """
    block = world_ground(ground, world).block
    pos = base_pos(arrays, world)
    heading = yaw_of(base_quat(arrays, world))
    distances = vec7()
    for i in range(3):
        aside = rotate_yaw(wp.vec3(0.0, 0.2 * float(1 - i), 0.0), heading)
        edges = edges_of_block(block, pos[0] + aside[0], pos[1] + aside[1], heading)
        distances[2 * i] = edges[0]
        distances[2 * i + 1] = edges[1]
    if block.exists != 0:
        distances[6] = float(block.height) - float(floor_surface(ground, block.center[0], block.center[1])[0])
    return distances


set_mirror((1,), wanted_height, jump_command, front_back=(1,))
set_mirror((1, 2), phase_times, height_errors)
set_mirror((1, -2), goal, landing_miss, way, front_back=(-1, 2))
set_mirror((1, 2, 3), phase)
set_mirror((5, 6, 3, 4, 1, 2, 7), block_ahead)  # begin and end of left, middle and right ray; height
