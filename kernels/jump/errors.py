"""How far a finished jump is from its goal."""

import warp as wp

from ..mdp.view import RobotView
from .state import JumpState, goal_offset


@wp.func
def height_error(robot: RobotView, state: JumpState) -> float:
    """Return the distance [m] of the highest base height from the wanted one."""
    return wp.abs(state.max_height - state.goal[2])


@wp.func
def landing_error(robot: RobotView, state: JumpState) -> float:
    """Return the horizontal distance [m] of the base from the goal."""
    return wp.length(goal_offset(robot, state))
