"""Configuration of velocity tracking: states at the start of episodes, ranges of commands, and the terrain map."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, ClassVar

import warp as wp

from jumper_warp.kernels.mdp.durations import NEVER
from jumper_warp.kernels.velocity.commands import CommandRanges, resample_due, resample_velocity, set_velocity
from jumper_warp.kernels.velocity.start_states import TileMap, VelocitySettings
from jumper_warp.robot.terrain import TerrainCfg, terrain_map
from jumper_warp.tasks.cfg import Command, TaskCfg
from jumper_warp.tasks.evaluation import Evaluation
from jumper_warp.tasks.ranges import Pair, check_ranges, filled
from jumper_warp.utils.checks import MOST_SETTING, check_bounds, check_probabilities, check_types
from jumper_warp.utils.errors import InputError
from jumper_warp.utils.kernels import KernelStruct

if TYPE_CHECKING:
    import newton

Reach = tuple[float, float, float, float]  # largest speeds: ahead, back, sideways [m/s], turning [rad/s]

VELOCITY_COMMAND = Command(
    set_velocity, resample_due, resample_velocity, optional=1,
    labels=("forward [m/s]", "left [m/s]", "turning [rad/s]", "gait [Hz]"), least=(None, None, None, 0.0),
)  # fmt: skip
"""Command of a velocity in body axes."""


@dataclass(frozen=True)
class VelocityEvaluation(Evaluation):
    """Evaluation of velocity tracking on level ground, with commands from a grid of velocities."""

    max_velocity: tuple[float, float, float] = (0.8, 0.8, 0.8)
    """[m/s], [m/s], [rad/s] Largest command ahead, to the left and about z, in both directions."""

    flags: ClassVar = "jumper_warp.evaluation.velocities:Velocity"
    published: ClassVar = {"slewed_rmse_vx_m_s": 0.17, "slewed_rmse_vy_m_s": 0.05, "slewed_rmse_yaw_rate_rad_s": 0.12}
    """Tracking errors of the paper: one test on the robot, with commands up to 0.8 m/s or rad/s given by a person."""

    def prepare_task(self, task: TaskCfg) -> TaskCfg:
        """Return the task on a plane."""
        return task.on_level_ground()


@dataclass(frozen=True)
class CommandCfg:
    """Ranges of sampled velocity commands, given as largest speeds (ahead, back, sideways [m/s], turning [rad/s])."""

    first_range: Reach = (0.8, 0.8, 0.8, 0.8)
    """Command range at the first curriculum level: largest speeds ahead, back, sideways [m/s] and turning [rad/s]."""
    last_range: Reach = (2.2, 1.6, 1.0, 1.4)
    """Command range at the last curriculum level, as `first_range`. Above the first level, a fast command along x
    limits the sideways and turning speeds."""
    levels: int = 10
    """Number of curriculum steps from the first level to the last; 0: first level only."""
    first_range_probability: float = 0.5
    """[1] Probability of a command from `first_range` at higher levels."""
    standing_probability: float = 0.12
    """[1] Probability of the command to stand."""
    turn_in_place_probability: float = 0.05
    """[1] Probability of a command to turn on the spot."""
    resampling_time_range: Pair = (2.0, 6.0)
    """[s] Time from one command to the next; infinity: one command for the whole episode."""
    smallest: float = 0.0
    """[m/s], [rad/s] Least magnitude of each sampled component of a command other than to stand.

    At high speeds ahead, the other components are reduced after this limit.
    """

    struct = CommandRanges
    """Type of the kernel struct that `values` returns."""

    def __post_init__(self) -> None:
        """Raise InputError if a range shrinks or is not positive, or a count, time or probability is out of range."""
        check_types("command", self)
        check_bounds("command", self, dict.fromkeys(("first_range", "last_range"), (-100.0, 100.0, "m/s, rad/s")))
        if not all(0.0 < low <= high for low, high in zip(self.first_range, self.last_range, strict=True)):
            raise InputError(f"command ranges must be positive and grow, got {self.first_range}, {self.last_range}")
        if not 0.0 <= self.smallest <= min(self.first_range):
            raise InputError(f"the smallest command must be in 0 to {min(self.first_range)}, got {self.smallest}")
        check_bounds("command", self, {"levels": (0, MOST_SETTING, "")})
        kinds = ("standing_probability", "turn_in_place_probability")
        check_probabilities("command", self, "first_range_probability", *kinds)
        if self.standing_probability + self.turn_in_place_probability > 1.0:
            raise InputError(f"command {' and '.join(kinds)} must add up to at most 1")
        low, high = self.resampling_time_range
        if not 0.0 < low <= high:
            raise InputError(f"resampling_time_range must be (lower, upper), positive, got ({low}, {high})")
        object.__setattr__(self, "resampling_time_range", (min(low, float(NEVER)), min(high, float(NEVER))))

    def values(self) -> KernelStruct:
        """Return the ranges of commands as a kernel struct, `CommandRanges`, with times in policy steps of 1/60 s."""
        ranges = filled(CommandRanges(), self, skip=("first_range", "last_range", "levels", "resampling_time_range"))
        ranges.first_range, ranges.last_range = wp.vec4(*self.first_range), wp.vec4(*self.last_range)
        ranges.levels = self.levels
        ranges.resampling_time_range = wp.vec2(*(60.0 * seconds for seconds in self.resampling_time_range))
        return ranges


@dataclass(frozen=True)
class VelocityResetCfg:
    """Ranges of the robot's state at the start of an episode of velocity tracking; angles in degrees."""

    episode: float = 20.0
    """[s] Length of an episode."""
    gait: float = 0.0
    """[Hz] Frequency of the gait clock, which the trot's observation and reward read; 0: no clock."""
    default_pose_probability: float = 0.1
    """[1] Probability of a start in the default pose at rest."""
    base_xy: float = 0.1
    """[m] Largest offset of the base along x and y at the start."""
    height: Pair = (0.30, 0.50)
    """[m] Height of the base above the ground at the start."""
    tilt: float = 5.0
    """[deg] Largest roll and pitch to either side at the start."""
    heading: float = 180.0
    """[deg] Largest heading to either side at the start."""
    front_x: Pair = (0.12, 0.32)
    """[m] Distance of the front paws ahead of the base at the start."""
    front_y: Pair = (0.12, 0.24)
    """[m] Distance of the front paws to either side of the base at the start."""
    back_x: Pair = (0.12, 0.32)
    """[m] Distance of the back paws behind the base at the start."""
    back_y: Pair = (0.16, 0.28)
    """[m] Distance of the back paws to either side of the base at the start."""
    max_swing_height: float = 0.10
    """[m] Largest height of a paw that is in the air at the start."""
    swing_probability: float = 0.3
    """[1] Probability that a paw is in the air at the start."""
    lin_vel: float = 0.5
    """[m/s] Largest speed of the base along x and y at the start; along z it is 0.3 times as large."""
    ang_vel: float = 0.5
    """[rad/s] Largest angular velocity of the base about each axis at the start."""
    tolerance: float = 0.18
    """[m/s] Largest mean error of an episode that raises the level: velocity error plus 0.3 m times yaw rate error."""
    terrain: TerrainCfg = field(default_factory=TerrainCfg.none)
    """Terrain map on which episodes start."""

    struct = VelocitySettings
    """Type of the kernel struct that `values` returns."""

    def __post_init__(self) -> None:
        """Raise InputError if a pair is reversed, or a number is not finite or out of range."""
        check_ranges("reset", self, skip=("terrain",), not_negative=vars(self))
        check_probabilities("reset", self, "default_pose_probability", "swing_probability")

    @property
    def max_episode_length_s(self) -> float:
        """Time limit of an episode [s]."""
        return self.episode

    def values(self, step_dt: float) -> KernelStruct:
        """Return the ranges of start states as a kernel struct, `VelocitySettings`.

        Angles are in radians, times in policy steps of step_dt [s].
        """
        settings = filled(VelocitySettings(), self, skip=("episode", "gait", "terrain"), degrees=("tilt", "heading"))
        settings.episode_steps = round(self.episode / step_dt)
        settings.pace = self.gait * step_dt
        tiles = TileMap()
        tiles.rows, tiles.cols, tiles.tile = self.terrain.rows, self.terrain.cols, self.terrain.tile
        settings.map = tiles
        return settings

    def heightfield(self) -> newton.Heightfield | None:
        """Return the terrain map; None: a plane."""
        return terrain_map(self.terrain) if self.terrain.rows else None

    def on_level_ground(self) -> VelocityResetCfg:
        """Return a copy of the configuration without a terrain map."""
        return replace(self, terrain=TerrainCfg.none())
