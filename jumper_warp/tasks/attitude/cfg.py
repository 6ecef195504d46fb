"""Configuration of turning in free flight: states at the start of episodes, and ranges of commanded turns."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import warp as wp

from jumper_warp.kernels.attitude.commands import TurnRanges
from jumper_warp.kernels.attitude.start_states import AttitudeSettings
from jumper_warp.tasks.evaluation import Evaluation
from jumper_warp.tasks.ranges import Pair, check_ranges, filled
from jumper_warp.utils.checks import check_positive, check_probabilities, check_types
from jumper_warp.utils.errors import InputError
from jumper_warp.utils.kernels import KernelStruct


@dataclass(frozen=True)
class AttitudeEvaluation(Evaluation):
    """Evaluation of commanded turns in free flight."""

    flags: ClassVar = "jumper_warp.evaluation.attitude:Attitude"


@dataclass(frozen=True)
class TurnCfg:
    """Curriculum level of turning in flight: the range from which resets sample commanded turns."""

    angle: Pair
    """[deg] Angle of a commanded turn."""
    body_axis_probability: float = 0.5
    """[1] Probability of a turn about body x, y or z; other turns have a uniformly random axis."""

    struct = TurnRanges
    """Type of the kernel struct that `values` returns."""

    def __post_init__(self) -> None:
        """Raise InputError unless 0 <= lower <= upper <= 180 deg and the probability is in 0 to 1."""
        check_types("turn", self)
        if not 0.0 <= self.angle[0] <= self.angle[1] <= 180.0:
            raise InputError(f"turn angle must be (lower, upper) within 0 to 180 degrees, got {self.angle}")
        check_probabilities("turn", self, "body_axis_probability")

    def values(self) -> KernelStruct:
        """Return the range of commanded turns as a kernel struct, `TurnRanges`, with angles in radians."""
        return filled(TurnRanges(), self, degrees=("angle",))


@dataclass(frozen=True)
class AttitudeResetCfg:
    """Ranges of the robot's state at the start of turning in flight, in any orientation; angles in degrees."""

    episode: Pair = (2.0, 4.0)
    """[s] Length of an episode, sampled so that worlds do not reset all at once."""
    height: float = 2.0
    """[m] Height of the base above the ground at the start."""
    default_pose_probability: float = 0.3
    """[1] Probability of a start in the default pose."""
    lateral: Pair = (-20.0, 80.0)
    """[deg] Lateral motor angles, positive outward, in starts outside the default pose."""
    transversal: Pair = (0.0, 105.0)
    """[deg] Outer and inner motor angles, positive away from the other thigh, in starts outside the default pose."""
    spin: float = 0.0
    """[rad/s] Largest angular velocity about each world axis at the start; 0: no angular momentum."""

    struct = AttitudeSettings
    """Type of the kernel struct that `values` returns."""

    def __post_init__(self) -> None:
        """Raise InputError if a pair is reversed, or a number is not finite or out of range."""
        check_ranges("reset", self, not_negative=("spin",))
        check_positive("reset episode", *self.episode)
        check_positive("reset height", self.height)
        check_probabilities("reset", self, "default_pose_probability")

    @property
    def max_episode_length_s(self) -> float:
        """Largest time limit of an episode [s], the upper end of `episode`."""
        return self.episode[1]

    def values(self, step_dt: float) -> KernelStruct:
        """Return the ranges of start states as a kernel struct, `AttitudeSettings`.

        Angles are in radians, times in policy steps of step_dt [s].
        """
        settings = filled(AttitudeSettings(), self, skip=("episode",), degrees=("lateral", "transversal"))
        settings.episode_steps = wp.vec2(*(seconds / step_dt for seconds in self.episode))
        return settings
