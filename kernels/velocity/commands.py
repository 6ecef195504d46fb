"""Velocity commands: sampled at resets and within episodes, or set from Python (`Env.command`).

A command is (ahead, to the left [m/s], yaw rate [rad/s]), body axes; positive yaw turns left. A curriculum widens its
range with a world's level. Random numbers are identified by an index in a stream (`streams`).
"""

import warp as wp

from ..mdp.durations import whole_steps
from ..mdp.env import Scene
from ..mdp.random import RngStream, uniform, uniform_range
from ..mdp.view import RobotView
from . import streams
from .state import POLICY_RATE, VelocityState

wp.set_module_options({"enable_backward": False})

MIN_COMMAND = wp.constant(0.05)  # [m/s], [rad/s] a command with all three components smaller means to stand


@wp.struct
class CommandRanges:
    """Ranges of sampled velocity commands; limits: largest speeds ahead, back, aside [m/s], turning [rad/s]."""

    first_range: wp.vec4  # limits at level 0
    last_range: wp.vec4  # limits at level `levels`
    levels: int  # index of the last level
    first_range_probability: float  # of a command within `first_range` at a higher level
    standing_probability: float  # of the command to stand
    turn_in_place_probability: float  # of a command with a yaw rate only
    resampling_time_range: wp.vec2  # [policy steps] from command to command
    smallest: float  # [m/s], [rad/s] least magnitude of each sampled component; 0: no limit


@wp.func
def command_limits(ranges: CommandRanges, level: int) -> wp.vec4:
    """Return the largest commanded speeds at a curriculum level: ahead, back, side [m/s], yaw rate [rad/s].

    The speeds are linear in the level, from the first to the last range.
    """
    if ranges.levels == 0:
        return ranges.first_range
    fraction = float(wp.min(level, ranges.levels)) / float(ranges.levels)
    return ranges.first_range + fraction * (ranges.last_range - ranges.first_range)


@wp.func
def sample_component(rng: RngStream, i: int, lower: float, upper: float, smallest: float) -> float:
    """Return a sampled component of a command, uniform between lower < 0 and upper > 0, at least `smallest` from 0.

    The two sides of the range are shrunk away from 0, so that no value is rejected.
    """
    value = uniform(rng, i, lower, upper)
    if smallest <= 0.0:
        return value
    limit = wp.where(value < 0.0, -lower, upper)
    magnitude = smallest + wp.abs(value) / limit * (limit - smallest)
    return wp.where(value < 0.0, -magnitude, magnitude)


@wp.func
def sample_velocity_command(rng: RngStream, ranges: CommandRanges, level: int) -> wp.vec3:
    """Return a sampled command of a level: velocity ahead, to the left [m/s], yaw rate [rad/s], body axes.

    Above level 0, a high forward speed reduces lateral velocity and yaw rate, by an ellipse, to a factor of at least
    0.2: commands do not combine the highest speeds.
    """
    kind = uniform(rng, streams.KIND, 0.0, 1.0)
    if kind < ranges.standing_probability:
        return wp.vec3(0.0)
    limits = command_limits(ranges, level)
    easy = level == 0 or uniform(rng, streams.NARROW, 0.0, 1.0) < ranges.first_range_probability
    if easy:
        limits = ranges.first_range
    spin = sample_component(rng, streams.TURN, -limits[3], limits[3], ranges.smallest)
    if kind < ranges.standing_probability + ranges.turn_in_place_probability:
        return wp.vec3(0.0, 0.0, spin)
    ahead = sample_component(rng, streams.AHEAD, -limits[1], limits[0], ranges.smallest)
    side = sample_component(rng, streams.SIDE, -limits[2], limits[2], ranges.smallest)
    if easy:
        return wp.vec3(ahead, side, spin)
    fraction = ahead / wp.where(ahead > 0.0, ranges.last_range[0], ranges.last_range[1])
    shrink = wp.sqrt(wp.max(1.0 - fraction * fraction, 0.04))
    return wp.vec3(ahead, shrink * side, shrink * spin)


@wp.func
def with_command(state: VelocityState, command: wp.vec3) -> VelocityState:
    """Return the task state with a new command (ahead, left [m/s], yaw rate [rad/s]); a small one means to stand."""
    new = state
    new.command = command
    new.command_steps = 0
    new.standing = wp.where(wp.max(wp.abs(command)) < MIN_COMMAND, 1, 0)
    if new.standing == 1:
        new.command = wp.vec3(0.0)
    return new


@wp.func
def resample_due(state: VelocityState) -> bool:
    """Return whether another velocity command is to be sampled in this policy step."""
    return state.command_lasts > 0 and state.command_steps >= state.command_lasts


@wp.func
def resample_velocity(
    robot: RobotView, scene: Scene, state: VelocityState, level: CommandRanges, rng: RngStream
) -> VelocityState:
    """Return the state with a newly sampled command and its duration; robot and scene are unused."""
    new = with_command(state, sample_velocity_command(rng, level, state.command_level))
    new.command_lasts = wp.max(whole_steps(uniform_range(rng, streams.LASTS, level.resampling_time_range)), 1)
    return new


@wp.func
def set_velocity(
    robot: RobotView, scene: Scene, state: VelocityState, values: wp.vec4, heading: float
) -> VelocityState:
    """Return the state with a velocity commanded by the host, which holds until the next command.

    values: velocity ahead, to the left [m/s], yaw rate [rad/s], body axes; gait frequency [Hz], 0: as before. The other
    arguments are unused.
    """
    new = with_command(state, wp.vec3(values[0], values[1], values[2]))
    if values[3] > 0.0:
        new.pace = values[3] / POLICY_RATE
    new.command_lasts = 0
    return new
