"""Errors of a finished jump: apex height and landing position."""

import warp as wp

from ..mdp.view import RobotView
from .state import JumpState, goal_offset


@wp.func
def height_error(robot: RobotView, state: JumpState) -> float:
    """Return the absolute difference [m] between the highest base height of the jump and the commanded one."""
    return wp.abs(state.max_height - state.goal[2])


@wp.func
def landing_error(robot: RobotView, state: JumpState) -> float:
    """Return the landing error of a jump: horizontal distance [m] between base origin and goal."""
    return wp.length(goal_offset(robot, state))
