"""Velocity commands: sampled at resets and within episodes, or set from outside."""

import warp as wp

from ..mdp.env import Scene
from ..mdp.random import RngStream, uniform, uniform_range
from ..mdp.view import RobotView
from . import streams
from .state import POLICY_RATE, VelocityState

wp.set_module_options({"enable_backward": False})

LEAST = wp.constant(0.05)  # [m/s], [rad/s] a command smaller in all three components means to stand


@wp.struct
class CommandRanges:
    """Ranges of drawn commands; reaches are (ahead, back, to either side [m/s], turning [rad/s])."""

    narrow: wp.vec4  # reach at the first level
    wide: wp.vec4  # reach at the last level
    levels: int  # from the first to the last
    narrow_share: float  # share of commands of the first level on all others
    stand: float  # share of commands to stand
    turn: float  # share of commands to turn on the spot
    lasts: wp.vec2  # [policy steps] from command to command


@wp.func
def reach_of(ranges: CommandRanges, level: int) -> wp.vec4:
    """Return the command limits at a level, linear between those of the first and the last one."""
    if ranges.levels == 0:
        return ranges.narrow
    share = float(wp.min(level, ranges.levels)) / float(ranges.levels)
    return ranges.narrow + share * (ranges.wide - ranges.narrow)


@wp.func
def sample_velocity_command(rng: RngStream, ranges: CommandRanges, level: int) -> wp.vec3:
    """Return a sampled command of a level: velocity ahead, to the left [m/s], yaw rate [rad/s].

    Beyond the first level, y and yaw shrink with the speed along x, as on an ellipse.
    """
    kind = uniform(rng, streams.KIND, 0.0, 1.0)
    if kind < ranges.stand:
        return wp.vec3(0.0)
    reach = reach_of(ranges, level)
    easy = level == 0 or uniform(rng, streams.NARROW, 0.0, 1.0) < ranges.narrow_share
    if easy:
        reach = ranges.narrow
    spin = uniform(rng, streams.TURN, -reach[3], reach[3])
    if kind < ranges.stand + ranges.turn:
        return wp.vec3(0.0, 0.0, spin)
    ahead = uniform(rng, streams.AHEAD, -reach[1], reach[0])
    side = uniform(rng, streams.SIDE, -reach[2], reach[2])
    if easy:
        return wp.vec3(ahead, side, spin)
    share = ahead / wp.where(ahead > 0.0, ranges.wide[0], ranges.wide[1])
    left = wp.sqrt(wp.max(1.0 - share * share, 0.04))
    return wp.vec3(ahead, left * side, left * spin)


@wp.func
def with_command(state: VelocityState, command: wp.vec3) -> VelocityState:
    """Return the state with a new command."""
    new = state
    new.command = command
    new.command_steps = 0
    new.standing = wp.where(wp.max(wp.abs(command)) < LEAST, 1, 0)
    if new.standing == 1:
        new.command = wp.vec3(0.0)
    return new


@wp.func
def command_due(state: VelocityState) -> bool:
    """Return whether another command is to be sampled in this policy step."""
    return state.command_lasts > 0 and state.command_steps >= state.command_lasts


@wp.func
def draw_command(
    robot: RobotView, scene: Scene, state: VelocityState, level: CommandRanges, rng: RngStream
) -> VelocityState:
    """Return the state with a newly sampled command."""
    new = with_command(state, sample_velocity_command(rng, level, state.command_level))
    new.command_lasts = wp.max(int(uniform_range(rng, streams.LASTS, level.lasts)), 1)
    return new


@wp.func
def give_velocity(
    robot: RobotView, scene: Scene, state: VelocityState, values: wp.vec4, heading: float
) -> VelocityState:
    """Return the state with a commanded velocity: ahead, to the left [m/s], yaw rate [rad/s], body axes.

    It holds until the next command. values[3]: gait frequency [Hz], 0: unchanged.
    """
    new = with_command(state, wp.vec3(values[0], values[1], values[2]))
    if values[3] > 0.0:
        new.pace = values[3] / POLICY_RATE
    new.command_lasts = 0
    return new
