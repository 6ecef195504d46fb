"""Reasons for an episode to end that any task can use: pure functions of the robot, the task's state and numbers.

A task's state counts its policy steps in `steps`.
"""

from typing import Any

import warp as wp

from .view import RobotView, has_diverged, tilt


@wp.func
def too_long(robot: RobotView, state: Any, steps: float) -> bool:
    """Episode of so many policy steps."""
    return state.steps >= int(steps)


@wp.func
def came_apart(robot: RobotView, state: Any) -> bool:
    """State non-finite or absurdly fast."""
    return has_diverged(robot)


@wp.func
def low_base(robot: RobotView, state: Any, height: float) -> bool:
    """Base less than a height [m] above the ground."""
    return robot.height < height


@wp.func
def tilted(robot: RobotView, state: Any, angle: float) -> bool:
    """Body z more than an angle [rad] from vertical."""
    return tilt(robot) > angle


@wp.func
def fallen(robot: RobotView, state: Any, angle: float) -> bool:
    """Body z more than an angle [rad] from vertical while a paw is on the ground."""
    return robot.contacts > 0 and tilt(robot) > angle


@wp.func
def collided(robot: RobotView, state: Any) -> bool:
    """Anything but a paw touched the ground, or links touched each other."""
    return robot.collisions != 0
