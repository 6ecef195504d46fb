"""How velocity tracking begins and what is commanded: starts, ranges of commands and the map, as data."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import Any

import newton
import warp as wp

from jumper_warp.kernels.velocity.commands import CommandRanges
from jumper_warp.kernels.velocity.start_states import Map, VelocitySettings
from jumper_warp.robot.terrain import TerrainCfg, terrain_map
from jumper_warp.tasks.ranges import Pair, check_ranges, filled
from jumper_warp.utils.checks import check_finite, check_shares
from jumper_warp.utils.errors import InputError

Reach = tuple[float, float, float, float]


@dataclass(frozen=True)
class CommandCfg:
    """Drawn commands. A reach is (ahead, back, to either side [m/s], turning to either side [rad/s])."""

    narrow: Reach = (0.8, 0.8, 0.8, 0.8)
    """At the first level."""
    wide: Reach = (2.2, 1.6, 1.0, 1.4)
    """At the last level. From the second on, going fast along x leaves less room for going sideways and turning."""
    levels: int = 10
    """Steps from the first level to the last; 0: all commands are of the first."""
    narrow_share: float = 0.5
    """[1] Share of commands of the first level on all others."""
    stand: float = 0.12
    """[1] Share of commands to stand."""
    turn: float = 0.05
    """[1] Share of commands to turn on the spot."""
    lasts: Pair = (2.0, 6.0)
    """[s] From command to command."""

    struct = CommandRanges
    """What the kernels read."""

    def __post_init__(self) -> None:
        """Raises ValueError: a range or a share is not one."""
        check_finite("command reach", *self.narrow, *self.wide)
        if not all(0.0 < low <= high for low, high in zip(self.narrow, self.wide, strict=True)):
            raise InputError(f"command reaches must be positive and not shrink, got {self.narrow}, {self.wide}")
        if self.levels < 0:
            raise InputError(f"command levels must not be negative, got {self.levels}")
        check_shares("command", narrow_share=self.narrow_share, stand=self.stand, turn=self.turn)
        if self.stand + self.turn > 1.0:
            raise InputError(f"command shares must add up to at most 1, got {self.stand}, {self.turn}")
        if not 0.0 < self.lasts[0] <= self.lasts[1] < math.inf:
            raise InputError(f"command lasts must be (lower, upper), positive and finite, got {self.lasts}")

    def values(self) -> Any:
        """Return the kernels' `CommandRanges`."""
        ranges = CommandRanges()
        ranges.narrow, ranges.wide, ranges.levels = wp.vec4(*self.narrow), wp.vec4(*self.wide), self.levels
        ranges.narrow_share, ranges.stand, ranges.turn = self.narrow_share, self.stand, self.turn
        ranges.lasts = wp.vec2(*(60.0 * seconds for seconds in self.lasts))
        return ranges


@dataclass(frozen=True)
class VelocityResetCfg:
    """How episodes begin; angles in degrees."""

    episode: float = 20.0
    """[s] Length of an episode."""
    gait: float = 0.0
    """[Hz] Frequency of the clock, 0: none. What it is for are the trot's observation and reward."""
    default_share: float = 0.1
    """[1] Share of episodes that begin in the default pose at rest."""
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
    lift: float = 0.10
    """[m] Most of paws in the air."""
    lifted_share: float = 0.3
    """[1] Share of paws in the air."""
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
        check_shares("reset", default_share=self.default_share, lifted_share=self.lifted_share)

    def values(self, step_dt: float) -> Any:
        """Return the kernels' `VelocitySettings`: angles in radians, times in policy steps of step_dt [s]."""
        settings = filled(VelocitySettings(), self, skip=("episode", "gait", "terrain"), degrees=("tilt", "heading"))
        settings.episode_steps, settings.pace = round(self.episode / step_dt), self.gait * step_dt
        tiles = Map()
        tiles.rows, tiles.cols, tiles.tile = self.terrain.rows, self.terrain.cols, self.terrain.tile
        settings.map = tiles
        return settings

    def heightfield(self) -> newton.Heightfield | None:
        """Return the map, None without one."""
        return terrain_map(self.terrain) if self.terrain.rows else None

    def on_level_ground(self) -> VelocityResetCfg:
        """Return the same without a map."""
        return replace(self, terrain=TerrainCfg.none())
