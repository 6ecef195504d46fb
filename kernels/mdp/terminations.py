"""Termination terms that any task can use, as functions of the robot's state, the task's state and parameters.

A task's state has the number of policy steps of the episode in `steps`. World z is up. `diverged`, or else the first
term of a task's table that holds, ends the episode.
"""

from typing import Any

import warp as wp

from .durations import whole_steps
from .view import RobotView, has_diverged, tilt


@wp.func
def too_long(robot: RobotView, state: Any, steps: float) -> bool:
    """Terminate an episode after `steps` policy steps."""
    return state.steps >= whole_steps(steps)


@wp.func
def diverged(robot: RobotView, state: Any) -> bool:
    """Terminate when the simulation diverges: state non-finite or beyond the speed limits of `has_diverged`."""
    return has_diverged(robot)


@wp.func
def low_base(robot: RobotView, state: Any, height: float) -> bool:
    """Terminate when the base origin is less than `height` [m] above the ground below it."""
    return robot.height < height


@wp.func
def tilted(robot: RobotView, state: Any, angle: float) -> bool:
    """Terminate when body z is more than `angle` [rad] from world z."""
    return tilt(robot) > angle


@wp.func
def fallen(robot: RobotView, state: Any, angle: float) -> bool:
    """Terminate when body z is more than `angle` [rad] from world z while a paw is on the ground.

    In flight a robot may be tilted, and turn before it lands.
    """
    return robot.contacts > 0 and tilt(robot) > angle


@wp.func
def collided(robot: RobotView, state: Any) -> bool:
    """Terminate when anything but a paw touches the ground, or links touch each other."""
    return robot.collisions != 0
