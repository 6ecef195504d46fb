"""Observation terms of turning in free flight, where the robot rotates by moving its legs.

`set_mirror` states how a term changes if the robot is mirrored left to right: column numbers, negative where the sign
changes.
"""

import warp as wp

from ..mdp.mirror import set_mirror
from ..mdp.view import RobotView
from .state import POLICY_RATE, AttitudeState, rotation_between


@wp.func
def turn_left(robot: RobotView, state: AttitudeState) -> wp.vec4:
    """Rotation from the robot's orientation to the goal orientation: quaternion xyzw with w >= 0, body axes.

    Both signs of a quaternion are the same rotation; w >= 0 makes it unique.
    """
    turn = rotation_between(robot.quat, state.goal)
    return wp.vec4(turn[0], turn[1], turn[2], turn[3])


@wp.func
def time_left(robot: RobotView, state: AttitudeState) -> float:
    """Time until the end of the episode [s]; 0 for an episode without end. The value of a state depends on it."""
    return float(wp.max(state.episode_steps - state.steps, 0)) / POLICY_RATE


@wp.func
def in_collision(robot: RobotView, state: AttitudeState) -> float:
    """Collision flag: 1 if links touch each other or anything but a paw touches the ground, else 0."""
    return wp.where(robot.collisions != 0, 1.0, 0.0)


set_mirror((-1, 2, -3, 4), turn_left)
set_mirror((1,), time_left, in_collision)
