"""Configuration of jumps: states at the start of episodes, grounds, and levels of the curriculum."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from itertools import product
from typing import Literal

import warp as wp

from jumper_warp.kernels.jump.ground_draws import MIN_EDGE_DISTANCE, GroundRanges
from jumper_warp.kernels.jump.reset import JumpLevel, JumpSettings, next_jump_due, resample_jump, set_jump
from jumper_warp.kernels.jump.start_states import ResetRanges
from jumper_warp.kernels.jump.state import vec_start_modes
from jumper_warp.tasks.cfg import Command
from jumper_warp.tasks.ranges import Pair, check_ranges, filled
from jumper_warp.utils.checks import check_positive, check_probabilities, check_types
from jumper_warp.utils.errors import InputError
from jumper_warp.utils.kernels import KernelStruct

JUMP_COMMAND = Command(
    set_jump, next_jump_due, resample_jump, optional=1,
    labels=("x [m]", "y [m]", "height [m]", "policy step of the command [1]"), least=(None, None, 0.0, 0.0),
)  # fmt: skip
"""Command of a jump: landing position relative to robot and heading, and height of the base at the apex, 0 for any."""


@dataclass(frozen=True)
class GroundCfg:
    """Ranges of platforms and blocks that resets sample for standing starts; other starts have level ground.

    They apply to randomised training on SolverJumper, unless the environment has its own ground or block.
    """

    platform: float = 0.0
    """[1] Probability of a start on a platform, where the paws have room to land next to it."""
    block: float = 0.0
    """[1] Probability of a sliding block under the goal, where there is room for the start in front of it."""
    drop: Pair = (0.03, 0.20)
    """[m] Height of sampled platforms above the floor."""
    rise: Pair = (0.02, 0.08)
    """[m] Height of sampled blocks above the floor."""
    room: float = 0.30
    """[m] Largest distance from the paws to an edge of the ground; the near edge of a block may be farther."""
    clearance: float = 0.12
    """[m] Smallest distance between the paws at the goal and an edge that the jump must cross."""
    mass: Pair = (5.0, 100.0)
    """[kg] Mass of sampled blocks."""
    friction: Pair = (0.3, 1.0)
    """[1] Friction coefficient between sampled blocks and the floor."""

    def __post_init__(self) -> None:
        """Raise InputError if a probability or length is out of range, or a pair reversed or not positive."""
        check_types("ground", self)
        if not (min(self.platform, self.block) >= 0.0 and self.platform + self.block <= 1.0):
            raise InputError(f"ground probabilities must be >= 0, in sum at most 1, got {self.platform}, {self.block}")
        for name, value in vars(self).items():
            if isinstance(value, tuple) and not 0.0 < value[0] <= value[1] < math.inf:
                raise InputError(f"ground {name} must be (lower, upper), positive and finite, got {value}")
        for name, least in (("room", MIN_EDGE_DISTANCE), ("clearance", 0.0)):
            if not least <= getattr(self, name) < math.inf:
                raise InputError(f"ground {name} must be finite and at least {least:g}, got {getattr(self, name)}")

    @property
    def drawn(self) -> bool:
        """Whether resets sample platforms or blocks as the ground of robots."""
        return self.platform + self.block > 0.0

    def ranges(self) -> KernelStruct:
        """Return the settings of sampled platforms and blocks as a kernel struct, `GroundRanges`."""
        return filled(GroundRanges(), self)


@dataclass(frozen=True)
class Level:
    """Level of a jump curriculum: ranges of sampled goals and of the base height in standing starts."""

    goal_lower: tuple[float, float, float]
    """[m] Smallest goal: landing x, y relative to start and heading, and base height at the apex (0: any)."""
    goal_upper: tuple[float, float, float]  # [m] Largest goal, as `goal_lower`
    base_height: Pair  # [m] Height of the base in standing starts; low ones are deep squats
    next_jump_probability: float = 0.0  # [1] Probability of another goal after a landing
    elliptical: bool = False
    """Whether goals lie in the ellipse within the box, with half axes up to its edges, instead of in the box.

    The box must contain the start.
    """

    struct = JumpLevel  # Kernels' struct that `values` returns

    def __post_init__(self) -> None:
        """Raise InputError if a range is reversed or not finite, or a height or probability is out of range."""
        check_types("level", self)
        pairs = [*zip(self.goal_lower, self.goal_upper, strict=True), self.base_height]
        if not all(-math.inf < low <= high < math.inf for low, high in pairs):
            raise InputError(f"a level's ranges must be finite and rise, got {self}")
        check_positive("base_height of a level", *self.base_height)
        check_probabilities("level", self, "next_jump_probability")

    def values(self) -> KernelStruct:
        """Return the curriculum level as a kernel struct, `JumpLevel`."""
        level = JumpLevel()
        level.goal_lower, level.goal_upper = wp.vec3(*self.goal_lower), wp.vec3(*self.goal_upper)
        level.base_height = wp.vec2(*self.base_height)
        level.next_jump_probability = self.next_jump_probability
        level.elliptical = int(self.elliptical)
        return level


def cross_levels(goals: Sequence[Level], starts: Sequence[Pair]) -> tuple[Level, ...]:
    """Return a curriculum that combines each level of goals with each range of initial base heights [m], easiest first.

    It has len(goals) * len(starts) levels. The curriculum of starts restarts with every level of goals, as in the
    authors' training.
    """
    return tuple(replace(goal, base_height=start) for goal, start in product(goals, starts))


@dataclass(frozen=True)
class StartProbability:
    """[1] Probabilities of the states in which an episode starts, such as standing or in flight; they add up to 1.

    The kernels number these states in the order of the fields.
    """

    standing: float = 0.0  # Standing on four paws, from upright to a deep squat
    default: float = 0.0  # In the default pose
    in_flight: float = 0.0  # between takeoff and landing
    touchdown: float = 0.0  # just before touchdown
    after_landing: float = 0.0  # on four paws near the goal
    pushing: float = 0.0  # During the push of a takeoff

    def __post_init__(self) -> None:
        """Raise InputError if a probability is negative, or they do not add up to 1."""
        check_types("start_probability", self)
        values = tuple(vars(self).values())
        if not min(values) >= 0.0 or not abs(sum(values) - 1.0) < 1.0e-6:
            raise InputError(f"start_probability must be >= 0 and add up to 1, got {vars(self)}")


@dataclass(frozen=True)
class ResetCfg:
    """Ranges of the robot's state at the start of a jump episode (reference state initialisation); angles [deg]."""

    start_probability: StartProbability = StartProbability(0.60, 0.15, 0.20, after_landing=0.05)
    balance_by: Literal["resets", "steps"] = "resets"
    """Quantity that `start_probability` divides: resets, or policy steps, which each world balances over its resets."""
    base_xy: float = 0.05
    """[m] Largest offset of the base along x and y at the start."""
    tilt: float = 5.0
    """[deg] Largest roll, pitch and yaw to either side at the start."""
    forward_pitch: float = 0.0
    """[deg] Largest mean pitch (nose down) of standing starts."""
    lean: float = 0.0
    """[m] Largest distance of the base behind the middle of the paws, away from the goal, in the deepest squats."""
    heading: float = 0.0
    """[deg] Largest heading to either side at the start."""
    front_x: Pair = (0.20, 0.22)
    """[m] Distance of the front paws ahead of the base at the start."""
    front_y: Pair = (0.15, 0.17)
    """[m] Distance of the front paws to either side of the base at the start."""
    back_x: Pair = (0.20, 0.22)
    """[m] Distance of the back paws behind the base at the start."""
    back_y: Pair = (0.20, 0.22)
    """[m] Distance of the back paws to either side of the base at the start."""
    takeoff_height: Pair = (0.40, 0.45)
    """[m] Height of the base at takeoff in starts in flight or during the push."""
    takeoff_ahead: Pair = (0.0, 0.0)
    """[m] Distance of the takeoff point from the start, towards the goal, in starts in flight or during the push."""
    takeoff_pitch: Pair = (0.0, 0.0)
    """[deg] Mean pitch of the base (nose down) in starts in flight or during the push."""
    push_length: Pair = (0.0, 0.4)
    """[m] Distance of the base from its takeoff point, along a straight line, in starts during the push."""
    push_acceleration: Pair = (10.0, 20.0)
    """[m/s^2] Acceleration of the base towards its takeoff point in starts during the push."""
    takeoff_angle: Pair = (50.0, 75.0)
    """[deg] Takeoff direction above the horizontal, for goals without an apex height."""
    highest_apex: float = 1.0
    """[m] Largest apex height of the base where the takeoff angle is sampled."""
    landing_height: float = 0.42
    """[m] Height of the base at the end of the sampled ballistic flight."""
    flight_time: Pair = (0.01, 0.95)
    """[1] Fraction of the flight time that has passed in in-flight starts."""
    flight_lateral: float = 10.0
    """[deg] Largest lateral motor angle to either side in in-flight starts."""
    flight_transversal: Pair = (0.0, 90.0)
    """[deg] Outer and inner motor angles in in-flight starts."""
    transversal_limit: float = 0.0
    """[deg] Largest outer and inner motor angle of all starts, if that of the command filter is smaller."""
    touchdown_time: Pair = (0.03, 0.15)
    """[s] Time from a touchdown start to the landing."""
    touchdown_behind: Pair = (0.0, 0.0)
    """[m] Distance of the base behind the ballistic path in touchdown starts, so that the paws are ahead of it."""
    paw_depth: Pair = (0.30, 0.45)
    """[m] Depth of the paws below the base in touchdown starts."""
    landed_height: Pair = (0.30, 0.42)
    """[m] Height of the base in after-landing starts."""
    landed_ahead: Pair = (0.0, 0.0)
    """[m] Distance of the base ahead of the goal in after-landing starts."""
    landed_speed: Pair = (0.0, 1.0)
    """[m/s] Downward speed of the base in after-landing starts."""
    ground: GroundCfg = field(default_factory=GroundCfg)
    """Platforms and blocks that standing starts sample."""
    command_delay: float = 0.5
    """[s] Longest time from reset to the command to jump."""
    long_wait_probability: float = 0.0
    """[1] Probability that `long_wait` replaces `command_delay`, so that policies learn to wait in a few episodes."""
    long_wait: float = 2.5
    """[s] Longest time from reset to the command to jump in episodes with a long wait."""
    next_jump_delay: Pair = (0.2, 0.7)
    """[s] Time from touchdown to the command of the next goal."""

    def __post_init__(self) -> None:
        """Raise InputError if a pair is reversed, or a number is not finite or out of range."""
        positive = ("command_delay", "long_wait", "next_jump_delay", "lean", "push_length", "push_acceleration")
        check_ranges("reset", self, skip=("start_probability", "ground", "balance_by"), not_negative=positive)
        check_probabilities("reset", self, "long_wait_probability")

    struct = JumpSettings
    """Type of the kernel struct that `values` returns."""

    def values(self, step_dt: float) -> KernelStruct:
        """Return the ranges of start states and grounds as a kernel struct, `JumpSettings`.

        Angles are in radians, delays in policy steps of step_dt [s].
        """
        settings = JumpSettings()
        settings.states = self._ranges(step_dt)
        settings.grounds = self.ground.ranges()
        return settings

    @property
    def draws_ground(self) -> bool:
        """Whether resets sample platforms or blocks."""
        return self.ground.drawn

    def on_level_ground(self) -> ResetCfg:
        """Return a copy of the configuration without sampled platforms and blocks, as for nominal evaluations."""
        return replace(self, ground=GroundCfg())

    def _ranges(self, step_dt: float) -> KernelStruct:
        """Return the ranges of start states as a kernel struct, `ResetRanges`; step_dt: policy step [s]."""
        degrees = (
            "tilt", "forward_pitch", "heading", "takeoff_angle", "takeoff_pitch", "flight_lateral",
            "flight_transversal", "transversal_limit",
        )  # fmt: skip
        converted = ("start_probability", "balance_by", "command_delay", "long_wait", "next_jump_delay", "ground")
        ranges = filled(ResetRanges(), self, skip=converted, degrees=degrees)
        ranges.start_probability = vec_start_modes(*vars(self.start_probability).values())
        ranges.by_steps = int(self.balance_by == "steps")
        ranges.command_delay = round(self.command_delay / step_dt)
        ranges.long_wait = round(self.long_wait / step_dt)
        ranges.next_jump_delay = wp.vec2(*(delay / step_dt for delay in self.next_jump_delay))
        return ranges
