"""Terminations of the attitude task; `mdp.terminations` has the terminations that all tasks share.

The first true term of a task ends the episode. `ended_clear`, a success, precedes `ended`.
"""

import warp as wp

from ..mdp.view import RobotView
from .state import AttitudeState


@wp.func
def ended_clear(robot: RobotView, state: AttitudeState) -> bool:
    """Terminate after `state.episode_steps` (not 0) policy steps if there was no collision in the episode."""
    return state.episode_steps > 0 and state.steps >= state.episode_steps and state.collisions == 0


@wp.func
def ended(robot: RobotView, state: AttitudeState) -> bool:
    """Terminate an episode after `state.episode_steps` policy steps; never if this number is 0."""
    return state.episode_steps > 0 and state.steps >= state.episode_steps
