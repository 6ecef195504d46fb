"""Reasons for an episode to end that any task can use: pure functions of the robot, the task's state and numbers.

A task's state counts its policy steps in `steps`.
"""

from typing import Any

import warp as wp

from .view import RobotView, speed_limit_broken, tilt


@wp.func
def too_long(view: RobotView, task: Any, steps: float) -> bool:
    """Episode of so many policy steps."""
    return task.steps >= int(steps)


@wp.func
def came_apart(view: RobotView, task: Any) -> bool:
    """State non-finite or absurdly fast."""
    return speed_limit_broken(view)


@wp.func
def low_base(view: RobotView, task: Any, height: float) -> bool:
    """Base less than a height [m] above the ground."""
    return view.height < height


@wp.func
def tilted(view: RobotView, task: Any, angle: float) -> bool:
    """Body z more than an angle [rad] from vertical."""
    return tilt(view) > angle


@wp.func
def fallen(view: RobotView, task: Any, angle: float) -> bool:
    """Body z more than an angle [rad] from vertical while a paw is on the ground."""
    return view.contacts > 0 and tilt(view) > angle


@wp.func
def collided(view: RobotView, task: Any) -> bool:
    """Anything but a paw touched the ground, or links touched each other."""
    return view.collisions != 0
