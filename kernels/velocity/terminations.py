"""Terminations of velocity tracking; `mdp.terminations` has the terminations that all tasks share."""

import warp as wp

from ..mdp.view import RobotView
from .state import VelocityState


@wp.func
def finished(robot: RobotView, state: VelocityState) -> bool:
    """Terminate an episode after `state.episode_steps` policy steps; never if this number is 0."""
    return state.episode_steps > 0 and state.steps >= state.episode_steps


@wp.func
def off_map(pos: wp.vec3, limit: wp.vec2) -> bool:
    """Return whether a base position [m], world, is beyond the map's half extents `limit` (x, y) [m]; 0: no map."""
    return limit[0] > 0.0 and (wp.abs(pos[0]) > limit[0] or wp.abs(pos[1]) > limit[1])


@wp.func
def left_map(robot: RobotView, state: VelocityState) -> bool:
    """Terminate when the base origin leaves the map; never without a map."""
    return off_map(robot.pos, state.limit)
