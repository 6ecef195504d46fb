"""Observation terms of jumps, for the policy and, of what only a simulation knows, for the critic."""

import warp as wp

from ..mdp.view import RobotView, turned, yaw_of
from .phase import estimated_apex, estimated_landing
from .state import JumpState, commanded, goal_offset

LANDING_HEIGHT = wp.constant(0.3)  # [m] of the base above the ground at the goal, where the critic's estimate ends


@wp.func
def wanted_height(view: RobotView, task: JumpState) -> float:
    """Commanded height of the base at the apex [m]."""
    return task.goal[2]


@wp.func
def jump_command(view: RobotView, task: JumpState) -> float:
    """Whether a jump is asked for and not yet landed (the paper's c)."""
    return wp.where(commanded(task), 1.0, 0.0)


@wp.func
def goal(view: RobotView, task: JumpState) -> wp.vec2:
    """Way to the goal [m] ahead and to the left, 0 before the command."""
    way = wp.vec3(0.0)
    if task.steps >= task.command_step:
        way = turned(goal_offset(view, task), -yaw_of(view.quat))
    return wp.vec2(way[0], way[1])


@wp.func
def phase(view: RobotView, task: JumpState) -> wp.vec3:
    """Which of stance, flight and landed it is [1]."""
    return wp.vec3(
        wp.where(task.phase == 0, 1.0, 0.0), wp.where(task.phase == 1, 1.0, 0.0), wp.where(task.phase == 2, 1.0, 0.0)
    )


@wp.func
def phase_times(view: RobotView, task: JumpState) -> wp.vec2:
    """Time in the phase, at most 2 s, and since the command, from -1 to 3 s."""
    return wp.vec2(
        wp.min(float(task.phase_steps), 120.0) / 60.0,
        wp.clamp(float(task.steps - task.command_step), -60.0, 180.0) / 60.0,
    )


@wp.func
def height_errors(view: RobotView, task: JumpState) -> wp.vec2:
    """Highest base height so far, and its ballistic estimate, less the wanted one [m]."""
    apex = estimated_apex(view.pos, view.lin_vel, view.fall_acc)
    return wp.vec2(task.max_height - task.goal[2], apex - task.goal[2])


@wp.func
def landing_miss(view: RobotView, task: JumpState) -> wp.vec2:
    """Way from the ballistic landing to the goal [m], ahead and to the left."""
    landing = estimated_landing(view.pos, view.lin_vel, LANDING_HEIGHT + task.goal_ground, view.fall_acc)
    miss = turned(wp.vec3(task.goal[0] - landing[0], task.goal[1] - landing[1], 0.0), -yaw_of(view.quat))
    return wp.vec2(miss[0], miss[1])


@wp.func
def way(view: RobotView, task: JumpState) -> wp.vec2:
    """Way to the goal [m] ahead and to the left, before the command too."""
    offset = turned(goal_offset(view, task), -yaw_of(view.quat))
    return wp.vec2(offset[0], offset[1])
