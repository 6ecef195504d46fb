"""How jumps begin: reference states, grounds and the levels of the curriculum, as data."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from itertools import product
from typing import Any, Literal

import warp as wp

from jumper_warp.kernels.jump.ground_draws import MIN_EDGE_DISTANCE, GroundRanges
from jumper_warp.kernels.jump.reset import JumpLevel, JumpSettings
from jumper_warp.kernels.jump.start_states import ResetRanges
from jumper_warp.kernels.jump.state import vec_start_modes
from jumper_warp.tasks.ranges import Pair, check_ranges, filled
from jumper_warp.utils.checks import check_positive, check_probabilities
from jumper_warp.utils.errors import InputError


@dataclass(frozen=True)
class GroundCfg:
    """What standing starts of a randomised training on SolverJumper stand on or jump to; elsewhere the ground is level.

    An environment that is given a ground or a block draws none.
    """

    platform: float = 0.0
    """[1] Share that begins on a platform, where the paws have room to land beside it."""
    block: float = 0.0
    """[1] Share with a block under the goal that slides, where there is room before it."""
    drop: Pair = (0.03, 0.20)
    """[m] Height of the platform."""
    rise: Pair = (0.02, 0.08)
    """[m] Height of the block."""
    room: float = 0.30
    """[m] Most between the paws and an edge, each way; the near side of a block may be farther from both."""
    clearance: float = 0.12
    """[m] Least between an edge that must be crossed and the paws at the goal."""
    mass: Pair = (5.0, 100.0)
    """[kg] Of the block."""
    friction: Pair = (0.3, 1.0)
    """[1] Of block and floor."""

    def __post_init__(self) -> None:
        """Raises ValueError: shares or lengths out of range, or a pair that is reversed, not positive or not finite."""
        if not (min(self.platform, self.block) >= 0.0 and self.platform + self.block <= 1.0):
            raise InputError(f"ground shares must be >= 0 and add up to at most 1, got {self.platform}, {self.block}")
        for name, value in vars(self).items():
            if isinstance(value, tuple) and not 0.0 < value[0] <= value[1] < math.inf:
                raise InputError(f"ground {name} must be (lower, upper), positive and finite, got {value}")
        for name, least in (("room", MIN_EDGE_DISTANCE), ("clearance", 0.0)):
            if not least <= getattr(self, name) < math.inf:
                raise InputError(f"ground {name} must be finite and at least {least:g}, got {getattr(self, name)}")

    @property
    def drawn(self) -> bool:
        """Whether there is anything but level ground."""
        return self.platform + self.block > 0.0

    def ranges(self) -> Any:
        """Return the kernels' `GroundRanges`."""
        return filled(GroundRanges(), self)


@dataclass(frozen=True)
class Level:
    """One level of the curriculum."""

    goal_lower: tuple[float, float, float]
    """Smallest goal relative to start and heading [m]: landing x, y, and base height at the apex (0: any)."""
    goal_upper: tuple[float, float, float]
    """Largest goal."""
    base_height: Pair
    """[m] Of standing starts; low ones are deep squats."""
    next_jump_probability: float = 0.0
    """[1] Of another goal for a landed robot."""
    elliptical: bool = False
    """Whether goals lie in the ellipse inside the box alone, whose half axes are the reaches each way."""

    struct = JumpLevel
    """What the kernels read."""

    def __post_init__(self) -> None:
        """Raises ValueError: a range is not one."""
        pairs = [*zip(self.goal_lower, self.goal_upper, strict=True), self.base_height]
        if not all(-math.inf < low <= high < math.inf for low, high in pairs):
            raise InputError(f"a level's ranges must be finite and rise, got {self}")
        check_positive("base_height of a level", *self.base_height)
        check_probabilities("level", self, "next_jump_probability")

    def values(self) -> Any:
        """Return the kernels' `JumpLevel`."""
        level = JumpLevel()
        level.goal_lower, level.goal_upper = wp.vec3(*self.goal_lower), wp.vec3(*self.goal_upper)
        level.base_height, level.next_jump_probability = wp.vec2(*self.base_height), self.next_jump_probability
        level.elliptical = int(self.elliptical)
        return level


def cross_levels(goals: Sequence[Level], starts: Sequence[Pair]) -> tuple[Level, ...]:
    """Return the levels of two curricula: for each level of goals all ranges of standing starts [m], easiest first.

    So the starts have their own curriculum, which begins anew with every level of goals, as the authors have it.
    """
    return tuple(replace(goal, base_height=start) for goal, start in product(goals, starts))


@dataclass(frozen=True)
class StartProbability:
    """[1] Probabilities of the modes in which an episode begins, in the order of the kernels; they add up to 1."""

    standing: float = 0.0
    """On four paws, from upright to a deep squat."""
    default: float = 0.0
    """In the default pose."""
    in_flight: float = 0.0
    touchdown: float = 0.0
    """Just before it."""
    after_landing: float = 0.0
    pushing: float = 0.0
    """During the push of a takeoff."""

    def __post_init__(self) -> None:
        """Raises ValueError: one is negative, or they do not add up to 1."""
        values = tuple(vars(self).values())
        if not min(values) >= 0.0 or not abs(sum(values) - 1.0) < 1.0e-6:
            raise InputError(f"start_probability must be >= 0 and add up to 1, got {vars(self)}")


@dataclass(frozen=True)
class ResetCfg:
    """Reference state initialisation: probabilities of start modes and ranges of their states; angles in degrees."""

    start_probability: StartProbability = StartProbability(0.60, 0.15, 0.20, after_landing=0.05)
    balance_by: Literal["resets", "steps"] = "resets"
    """Whether the probabilities are of resets, or of policy steps, which a world evens out from reset to reset."""
    base_xy: float = 0.05
    """[m]"""
    tilt: float = 5.0
    """[deg] Roll, pitch and yaw."""
    forward_pitch: float = 0.0
    """[deg] Largest mean pitch of standing states."""
    lean: float = 0.0
    """[m] Farthest that the base of the deepest squats is behind the middle of the paws, away from the goal."""
    heading: float = 0.0
    """[deg] Half width of the heading."""
    front_x: Pair = (0.20, 0.22)
    """[m] Paw positions relative to the base."""
    front_y: Pair = (0.15, 0.17)
    """[m]"""
    back_x: Pair = (0.20, 0.22)
    """[m]"""
    back_y: Pair = (0.20, 0.22)
    """[m]"""
    takeoff_height: Pair = (0.40, 0.45)
    """[m]"""
    takeoff_ahead: Pair = (0.0, 0.0)
    """[m] Base ahead of its start, towards the goal."""
    takeoff_pitch: Pair = (0.0, 0.0)
    """[deg] Mean pitch, nose down, in flight and pushing off."""
    push_length: Pair = (0.0, 0.4)
    """[m] Of the straight way to the takeoff, on which the base of those that push off is."""
    push_acceleration: Pair = (10.0, 20.0)
    """[m/s^2] On it."""
    takeoff_angle: Pair = (50.0, 75.0)
    """[deg] Above the horizon, where the goal names no apex."""
    highest_apex: float = 1.0
    """[m] Of jumps with a drawn takeoff angle."""
    landing_height: float = 0.42
    """[m] Of the base, where the projectile ends."""
    flight_time: Pair = (0.01, 0.95)
    """[1] Share of the time in the air."""
    flight_lateral: float = 10.0
    """[deg]"""
    flight_transversal: Pair = (0.0, 90.0)
    """[deg]"""
    touchdown_time: Pair = (0.03, 0.15)
    """[s] Before landing."""
    touchdown_behind: Pair = (0.0, 0.0)
    """[m] Base behind the projectile before touchdown, so that the paws are ahead of it."""
    paw_depth: Pair = (0.30, 0.45)
    """[m] Paws below the base before touchdown."""
    landed_height: Pair = (0.30, 0.42)
    """[m]"""
    landed_ahead: Pair = (0.0, 0.0)
    """[m] Base ahead of the goal just after landing."""
    landed_speed: Pair = (0.0, 1.0)
    """[m/s] Downward."""
    ground: GroundCfg = field(default_factory=GroundCfg)
    """What standing starts stand on or jump to."""
    command_delay: float = 0.5
    """[s] Longest time until the jump is commanded."""
    long_wait_probability: float = 0.0
    """[1] Of `long_wait` instead: a policy learns to wait, and most episodes stay short."""
    long_wait: float = 2.5
    """[s]"""
    next_jump_delay: Pair = (0.2, 0.7)
    """[s] From touchdown to the next goal."""

    def __post_init__(self) -> None:
        """Raises ValueError: a pair is reversed, a number not finite or out of range."""
        positive = ("command_delay", "long_wait", "next_jump_delay", "lean", "push_length", "push_acceleration")
        check_ranges("reset", self, skip=("start_probability", "ground", "balance_by"), not_negative=positive)
        check_probabilities("reset", self, "long_wait_probability")
        if self.balance_by not in ("resets", "steps"):
            raise InputError(f"reset balance_by must be resets or steps, got {self.balance_by!r:.40}")

    struct = JumpSettings
    """What the kernels read."""

    def values(self, step_dt: float) -> Any:
        """Return the kernels' `JumpSettings`: angles in radians, delays in policy steps of step_dt [s]."""
        settings = JumpSettings()
        settings.states, settings.grounds = self._ranges(step_dt), self.ground.ranges()
        return settings

    @property
    def draws_ground(self) -> bool:
        """Whether there is anything but level ground."""
        return self.ground.drawn

    def on_level_ground(self) -> ResetCfg:
        """Return the same with level ground only."""
        return replace(self, ground=GroundCfg())

    def _ranges(self, step_dt: float) -> Any:
        degrees = (
            "tilt", "forward_pitch", "heading", "takeoff_angle", "takeoff_pitch", "flight_lateral",
            "flight_transversal",
        )  # fmt: skip
        apart = ("start_probability", "balance_by", "command_delay", "long_wait", "next_jump_delay", "ground")
        ranges = filled(ResetRanges(), self, apart, degrees)
        ranges.start_probability = vec_start_modes(*vars(self.start_probability).values())
        ranges.by_steps = int(self.balance_by == "steps")
        ranges.command_delay = round(self.command_delay / step_dt)
        ranges.long_wait = round(self.long_wait / step_dt)
        ranges.next_jump_delay = wp.vec2(*(delay / step_dt for delay in self.next_jump_delay))
        return ranges
