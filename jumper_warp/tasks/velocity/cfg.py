"""How velocity tracking begins and what is commanded: starts, ranges of commands and the map, as data."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import Any

import newton
import warp as wp

from jumper_warp.kernels.velocity.commands import CommandRanges
from jumper_warp.kernels.velocity.start_states import TileMap, VelocitySettings
from jumper_warp.robot.terrain import TerrainCfg, terrain_map
from jumper_warp.tasks.ranges import Pair, check_ranges, filled
from jumper_warp.utils.checks import check_finite, check_probabilities
from jumper_warp.utils.errors import InputError

Reach = tuple[float, float, float, float]


@dataclass(frozen=True)
class CommandCfg:
    """Drawn commands. A reach is (ahead, back, to either side [m/s], turning to either side [rad/s])."""

    first_range: Reach = (0.8, 0.8, 0.8, 0.8)
    """At the first level."""
    last_range: Reach = (2.2, 1.6, 1.0, 1.4)
    """At the last level. From the second on, going fast along x leaves less room for going sideways and turning."""
    levels: int = 10
    """Steps from the first level to the last; 0: all commands are of the first."""
    first_range_probability: float = 0.5
    """[1] Of a command of the first level on all others."""
    standing_probability: float = 0.12
    """[1] Of the command to stand."""
    turn_in_place_probability: float = 0.05
    """[1] Of a command to turn on the spot."""
    resampling_time_range: Pair = (2.0, 6.0)
    """[s] From command to command."""

    struct = CommandRanges
    """What the kernels read."""

    def __post_init__(self) -> None:
        """Raises ValueError: a range or a probability is not one."""
        check_finite("command reach", *self.first_range, *self.last_range)
        if not all(0.0 < low <= high for low, high in zip(self.first_range, self.last_range, strict=True)):
            raise InputError(f"command ranges must be positive and grow, got {self.first_range}, {self.last_range}")
        if self.levels < 0:
            raise InputError(f"command levels must not be negative, got {self.levels}")
        kinds = ("standing_probability", "turn_in_place_probability")
        check_probabilities("command", self, "first_range_probability", *kinds)
        if self.standing_probability + self.turn_in_place_probability > 1.0:
            raise InputError(f"command {' and '.join(kinds)} must add up to at most 1")
        low, high = self.resampling_time_range
        if not 0.0 < low <= high < math.inf:
            raise InputError(f"resampling_time_range must be (lower, upper), positive and finite, got ({low}, {high})")

    def values(self) -> Any:
        """Return the kernels' `CommandRanges`."""
        ranges = filled(CommandRanges(), self, skip=("first_range", "last_range", "levels", "resampling_time_range"))
        ranges.first_range, ranges.last_range = wp.vec4(*self.first_range), wp.vec4(*self.last_range)
        ranges.levels = self.levels
        ranges.resampling_time_range = wp.vec2(*(60.0 * seconds for seconds in self.resampling_time_range))
        return ranges


@dataclass(frozen=True)
class VelocityResetCfg:
    """How episodes begin; angles in degrees."""

    episode: float = 20.0
    """[s] Length of an episode."""
    gait: float = 0.0
    """[Hz] Frequency of the clock, 0: none. What it is for are the trot's observation and reward."""
    default_pose_probability: float = 0.1
    """[1] Of a start in the default pose at rest."""
    base_xy: float = 0.1
    """[m] Half width."""
    height: Pair = (0.30, 0.50)
    """[m] Of the base above the ground."""
    tilt: float = 5.0
    """[deg] Half width of roll and pitch."""
    heading: float = 180.0
    """[deg] Half width of the heading."""
    front_x: Pair = (0.12, 0.32)
    """[m] Paws relative to the base."""
    front_y: Pair = (0.12, 0.24)
    """[m]"""
    back_x: Pair = (0.12, 0.32)
    """[m]"""
    back_y: Pair = (0.16, 0.28)
    """[m]"""
    max_swing_height: float = 0.10
    """[m] Greatest height of paws in the air."""
    swing_probability: float = 0.3
    """[1] Of a paw being in the air."""
    lin_vel: float = 0.5
    """[m/s] Half width of the base's velocity along x and y, three tenths of it along z."""
    ang_vel: float = 0.5
    """[rad/s] Half width of its angular velocity about each axis."""
    tolerance: float = 0.18
    """[m/s] Mean error up to which an episode raises the levels: of the velocity, and 0.3 m of that of the yaw rate."""
    terrain: TerrainCfg = field(default_factory=TerrainCfg.none)
    """The map that episodes begin on."""

    struct = VelocitySettings
    """What the kernels read."""

    def __post_init__(self) -> None:
        """Raises ValueError: a pair is reversed, a number not finite or out of range."""
        check_ranges("reset", self, skip=("terrain",), not_negative=vars(self))
        check_probabilities("reset", self, "default_pose_probability", "swing_probability")

    def values(self, step_dt: float) -> Any:
        """Return the kernels' `VelocitySettings`: angles in radians, times in policy steps of step_dt [s]."""
        settings = filled(VelocitySettings(), self, skip=("episode", "gait", "terrain"), degrees=("tilt", "heading"))
        settings.episode_steps, settings.pace = round(self.episode / step_dt), self.gait * step_dt
        tiles = TileMap()
        tiles.rows, tiles.cols, tiles.tile = self.terrain.rows, self.terrain.cols, self.terrain.tile
        settings.map = tiles
        return settings

    def heightfield(self) -> newton.Heightfield | None:
        """Return the map, None without one."""
        return terrain_map(self.terrain) if self.terrain.rows else None

    def on_level_ground(self) -> VelocityResetCfg:
        """Return the same without a map."""
        return replace(self, terrain=TerrainCfg.none())
