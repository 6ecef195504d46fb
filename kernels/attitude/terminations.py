"""Why an episode of turning in free flight ends, besides what ends any task's."""

import warp as wp

from ..mdp.view import RobotView
from .state import AttitudeState


@wp.func
def ended_clear(robot: RobotView, state: AttitudeState) -> bool:
    """The episode has lasted as long as it should, and nothing has touched anything."""
    return state.episode_steps > 0 and state.steps >= state.episode_steps and state.collisions == 0


@wp.func
def ended(robot: RobotView, state: AttitudeState) -> bool:
    """The episode has lasted as long as it should."""
    return state.episode_steps > 0 and state.steps >= state.episode_steps
