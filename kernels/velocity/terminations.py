"""Why an episode of velocity tracking ends, besides what ends any task's."""

import warp as wp

from ..mdp.view import RobotView
from .state import VelocityState


@wp.func
def finished(robot: RobotView, state: VelocityState) -> bool:
    """The episode has lasted as long as it should."""
    return state.episode_steps > 0 and state.steps >= state.episode_steps


@wp.func
def off_map(pos: wp.vec3, limit: wp.vec2) -> bool:
    """Return whether a base position [m] is beyond the limit of a map along x or y; never without a map."""
    return limit[0] > 0.0 and (wp.abs(pos[0]) > limit[0] or wp.abs(pos[1]) > limit[1])


@wp.func
def left_map(robot: RobotView, state: VelocityState) -> bool:
    """The base comes near the edge of the map."""
    return off_map(robot.pos, state.limit)
