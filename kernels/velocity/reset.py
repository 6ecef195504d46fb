"""Reset of velocity tracking: update curriculum levels, sample a command; `start_states` samples the robot state.

Each world has two levels, of commanded speeds and of terrain difficulty; both rise with success and fall after falls.
"""

import warp as wp

from ..mdp.attempts import sync_attempts
from ..mdp.durations import whole_steps
from ..mdp.env import Scene, SkillSettings
from ..mdp.random import RngStream, uniform, uniform_range
from ..mdp.view import RobotArrays, base_pos
from ..terrain.ground import rest_block
from . import streams
from .commands import CommandRanges, sample_velocity_command, with_command
from .start_states import TileMap, VelocitySettings, write_start
from .state import VelocityState, mean_error
from .terminations import off_map

wp.set_module_options({"enable_backward": False})

FALL_PENALTY = wp.constant(60.0)  # [m/s] subtracted from the score for a fall, as much as a second at 1 m/s adds


@wp.func
def map_limit(map: TileMap) -> wp.vec2:
    """Return the half extents [m] of the terrain map along x and y, from its centre, the origin; 0 without a map."""
    return 0.5 * map.tile * wp.vec2(float(map.rows), float(map.cols))


@wp.func
def carried_over(
    old: VelocityState, pos: wp.vec3, tolerance: float, command_levels: int, terrain_levels: int
) -> VelocityState:  # fmt: skip
    """Return a state for a new episode with the accumulated statistics of `old` and updated curriculum levels.

    The reset sets the other fields. pos [m]: base at the end of the old episode. A full episode with a mean error up to
    `tolerance` [m/s] raises both levels by 1, a fall lowers them by 1. command_levels, terrain_levels: largest levels.
    """
    new = VelocityState()
    new.sum_xy = old.sum_xy
    new.sum_yaw = old.sum_yaw
    new.sum_settled = old.sum_settled
    new.score = old.score
    new.all_steps = old.all_steps
    new.minutes = old.minutes
    new.seconds_walking = old.seconds_walking
    new.falls = old.falls
    new.touchdowns = old.touchdowns
    new.apexes = old.apexes
    change = int(0)
    if old.steps > 0 and old.episode_steps > 0 and not off_map(pos, old.limit):
        if old.steps < old.episode_steps:
            new.falls = old.falls + 1.0
            new.score = old.score - FALL_PENALTY
            change = int(-1)
        elif old.settled > 0.0 and mean_error(old) <= tolerance:
            change = int(1)
    new.command_level = wp.clamp(old.command_level + change, 0, command_levels)
    new.terrain_level = wp.clamp(old.terrain_level + change, 0, terrain_levels)
    return new


@wp.func
def reset_velocity(
    arrays: RobotArrays, scene: Scene, skill: SkillSettings, old: VelocityState, settings: VelocitySettings,
    level: CommandRanges, rng: RngStream,
) -> VelocityState:  # fmt: skip
    """Write a sampled start state to world `rng.world`, and return the task state, with a sampled command.

    old: state of the previous episode. level: ranges of commands.
    """
    world = rng.world
    new = carried_over(old, base_pos(arrays, world), settings.tolerance, level.levels, settings.map.rows)
    rest_block(scene.ground, world)
    sync_attempts(rng)  # all threads must have read the base position
    write_start(arrays, scene, skill, settings, new.terrain_level, rng)
    new.episode_steps = settings.episode_steps
    new.pace = settings.pace
    new.phase = uniform(rng, streams.GAIT_PHASE, 0.0, 1.0)
    new.limit = map_limit(settings.map)
    new = with_command(new, sample_velocity_command(rng, level, new.command_level))
    new.command_lasts = wp.max(whole_steps(uniform_range(rng, streams.LASTS, level.resampling_time_range)), 1)
    return new
