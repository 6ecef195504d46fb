"""Errors of a finished jump: apex height and landing position.

The curriculum raises a world's level after jumps whose error is small. Positions belong to the base origin, world
frame, z up. `state.goal` is (x, y of the landing, base height at the apex).
"""

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
