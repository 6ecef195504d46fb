"""Observation terms of jumps, for the policy and, of what only a simulation knows, for the critic."""

import warp as wp

from ..mdp.view import RobotArrays, RobotView, base_pos, base_quat, rotate_yaw, yaw_of
from ..terrain.ground import Block, Ground, floor_surface, world_ground
from .phase import estimated_apex, estimated_landing
from .state import JumpState, commanded, goal_offset

SIGHT = wp.constant(2.0)  # [m] how far blocks are seen
vec7 = wp.types.vector(length=7, dtype=wp.float32)
LANDING_HEIGHT = wp.constant(0.3)  # [m] of the base above the ground at the goal, where the critic's estimate ends


@wp.func
def wanted_height(robot: RobotView, state: JumpState) -> float:
    """Commanded height of the base at the apex [m]."""
    return state.goal[2]


@wp.func
def jump_command(robot: RobotView, state: JumpState) -> float:
    """Whether a jump is asked for and not yet landed (the paper's c)."""
    return wp.where(commanded(state), 1.0, 0.0)


@wp.func
def goal(robot: RobotView, state: JumpState) -> wp.vec2:
    """Way to the goal [m] ahead and to the left, 0 before the command."""
    way = wp.vec3(0.0)
    if state.steps >= state.command_step:
        way = rotate_yaw(goal_offset(robot, state), -yaw_of(robot.quat))
    return wp.vec2(way[0], way[1])


@wp.func
def phase(robot: RobotView, state: JumpState) -> wp.vec3:
    """Which of stance, flight and landed it is [1]."""
    return wp.vec3(
        wp.where(state.phase == 0, 1.0, 0.0), wp.where(state.phase == 1, 1.0, 0.0), wp.where(state.phase == 2, 1.0, 0.0)
    )


@wp.func
def phase_times(robot: RobotView, state: JumpState) -> wp.vec2:
    """Time in the phase, at most 2 s, and since the command, from -1 to 3 s."""
    return wp.vec2(
        wp.min(float(state.phase_steps), 120.0) / 60.0,
        wp.clamp(float(state.steps - state.command_step), -60.0, 180.0) / 60.0,
    )


@wp.func
def height_errors(robot: RobotView, state: JumpState) -> wp.vec2:
    """Highest base height so far, and its ballistic estimate, less the wanted one [m]."""
    apex = estimated_apex(robot.pos, robot.lin_vel, robot.gravity_magnitude)
    return wp.vec2(state.max_height - state.goal[2], apex - state.goal[2])


@wp.func
def landing_miss(robot: RobotView, state: JumpState) -> wp.vec2:
    """Way from the ballistic landing to the goal [m], ahead and to the left."""
    landing = estimated_landing(robot.pos, robot.lin_vel, LANDING_HEIGHT + state.goal_ground, robot.gravity_magnitude)
    miss = rotate_yaw(wp.vec3(state.goal[0] - landing[0], state.goal[1] - landing[1], 0.0), -yaw_of(robot.quat))
    return wp.vec2(miss[0], miss[1])


@wp.func
def way(robot: RobotView, state: JumpState) -> wp.vec2:
    """Way to the goal [m] ahead and to the left, before the command too."""
    offset = rotate_yaw(goal_offset(robot, state), -yaw_of(robot.quat))
    return wp.vec2(offset[0], offset[1])


@wp.func
def span_of_ray(offset: float, half: float, direction: float) -> wp.vec2:
    """Return where [m] along a ray a slab of a half width [m] begins and ends, its middle `offset` [m] ahead."""
    if wp.abs(direction) < 1.0e-6:
        return wp.where(wp.abs(offset) <= half, wp.vec2(-1.0e6, 1.0e6), wp.vec2(1.0e6, -1.0e6))
    near = (offset - half) / direction
    far = (offset + half) / direction
    return wp.vec2(wp.min(near, far), wp.max(near, far))


@wp.func
def edges_of_block(block: Block, from_x: float, from_y: float, heading: float) -> wp.vec2:
    """Return where [m] a ray enters and leaves a block, seen from -SIGHT to SIGHT; both SIGHT if it passes by."""
    along_x = span_of_ray(float(block.center[0]) - from_x, float(block.half[0]), wp.cos(heading))
    along_y = span_of_ray(float(block.center[1]) - from_y, float(block.half[1]), wp.sin(heading))
    enter = wp.max(along_x[0], along_y[0])
    leave = wp.min(along_x[1], along_y[1])
    if block.exists == 0 or enter >= leave or enter > SIGHT:
        return wp.vec2(SIGHT, SIGHT)
    return wp.vec2(wp.max(enter, -SIGHT), wp.min(leave, SIGHT))


@wp.func
def block_ahead(arrays: RobotArrays, ground: Ground, world: int) -> vec7:
    """What the block ahead is like: where it begins and ends [m] ahead of the base, and its height above the floor [m].

    Along three rays in the base's heading, 0.2 m to its left, through it and to its right; 2 m where there is none.
    """
    block = world_ground(ground, world).block
    pos = base_pos(arrays, world)
    heading = yaw_of(base_quat(arrays, world))
    seen = vec7()
    for i in range(3):
        aside = rotate_yaw(wp.vec3(0.0, 0.2 * float(1 - i), 0.0), heading)
        edges = edges_of_block(block, pos[0] + aside[0], pos[1] + aside[1], heading)
        seen[2 * i] = edges[0]
        seen[2 * i + 1] = edges[1]
    if block.exists != 0:
        seen[6] = float(block.height) - float(floor_surface(ground, block.center[0], block.center[1])[0])
    return seen
