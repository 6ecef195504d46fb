"""Bounds of the numbers of terms and of randomisation ranges, both in a configuration and in `Env.set`.

Kernels do not check their numbers: a width of 0 would give NaN rewards, a negative mass a diverging simulation.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping

import numpy as np

from jumper_warp.kernels.mdp import parameters
from jumper_warp.kernels.mdp.durations import NEVER
from jumper_warp.robot.description import load_description
from jumper_warp.robot.overlay import RANDOMIZED
from jumper_warp.utils.errors import InputError
from jumper_warp.utils.kernels import Function

LARGEST = 1.0e9  # Largest absolute value of a term's number
SMALLEST_WIDTH = 1.0e-6  # Of a reward kernel, in its unit; float32 can hold its square
DURATION = re.compile(r"(\w+_)?steps|settle|interval_range_s")
WIDTH = re.compile(r"(std|width)(_\w+)?")
DIVISOR = re.compile(r"scale(_\w+)?|speed_scale|limit|angle|weight_force|acceleration")
"""Names of parameters by which the project's rewards and terminations divide, in addition to WIDTH."""
PROBABILITY = re.compile(r"(\w+_)?probability")

EVENT_RANGES: dict[Function, dict[str, tuple[str, float]]] = {
    parameters.base_mass: {"": ("base_mass", 1.0)},
    parameters.link_mass: {"": ("link_mass", 1.0)},
    parameters.com_shift: {"": ("com_shift", 1.0)},
    parameters.armature: {"": ("armature", 1.0)},
    parameters.motor_friction: {"": ("motor_friction", 1.0)},
    parameters.gains: {"kp_": ("gains", 1.0), "kd_": ("damping_gains", 1.0)},
    parameters.speed_limits: {"no_load_": ("no_load_speed", 1.0), "cutoff_": ("cutoff_speed", 1.0)},
    parameters.joint_offset: {"": ("joint_offset", math.pi / 180.0)},
    parameters.friction: {"dynamic_": ("dynamic_friction", 1.0), "static_": ("static_friction", 1.0)},
    parameters.action_latency: {"": ("latency", 1.0e-3)},
    parameters.observation_latency: {"": ("observation_latency", 1.0e-3)},
    parameters.push: {"force_": ("push_force", 1.0), "torque_": ("push_torque", 1.0)},
}
"""Ranges by which an event samples, by the prefix of its numbers `lower` and `upper`: the field of `RandomizationCfg`,
and the event's unit in the unit of the field."""


def checked_number(where: str, key: str, value: object, divides: bool = False) -> float:
    """Return a parameter of a term if it is within bounds; a duration is at most NEVER.

    Names decide on bounds: durations (DURATION) are 0 or more, widths of kernels (WIDTH, with `divides` DIVISOR)
    positive, probabilities (PROBABILITY) within 0 to 1; all but durations are within LARGEST.
    Raises InputError: the value is out of bounds or not a real number. where: term, for messages.
    """
    low, high, words = -LARGEST, LARGEST, f"a finite number within {LARGEST:g}"
    if DURATION.fullmatch(key):
        low, high, words = 0.0, math.inf, "0 or more, infinite for never"
    elif PROBABILITY.fullmatch(key):
        low, high, words = 0.0, 1.0, "in 0 to 1"
    elif WIDTH.fullmatch(key) or (divides and DIVISOR.fullmatch(key)):
        low, words = SMALLEST_WIDTH, f"a width of {SMALLEST_WIDTH:g} to {LARGEST:g}"
    if isinstance(value, bool) or not isinstance(value, int | float | np.number) or not low <= value <= high:
        raise InputError(f"{where}: parameter {key!r} must be {words}, got {value!r:.60}")
    value = value if isinstance(value, int) else float(value)
    return min(value, float(NEVER)) if DURATION.fullmatch(key) else value


def check_event_ranges(func: Function, numbers: Mapping[str, float]) -> None:
    """Raise InputError unless the ranges of one of the project's events are valid; numbers: its parameters by name."""
    for prefix, (field, unit) in EVENT_RANGES.get(func, {}).items():
        check_range(field, (numbers[f"{prefix}lower"], numbers[f"{prefix}upper"]), unit)


def check_range(name: str, pair: tuple[float, float], unit: float = 1.0) -> None:
    """Raise InputError unless a randomisation range rises, within the bounds of a field of `RandomizationCfg`.

    name: the field; unit: its unit, in the unit of the pair.
    """
    low, high, word = RANDOMIZED[name]
    for end in pair:
        if not unit * low <= end <= unit * high:
            limits = f"{low:g} to {high:g}{word and ' '}{word}"
            raise InputError(f"randomisation range {name} must be in {limits}, got {end / unit!s:.40}")
    if not pair[0] <= pair[1]:
        raise InputError(f"randomisation range {name} must rise, got {tuple(end / unit for end in pair)}")
    least, exclusive = _least(name)
    if pair[0] < least or (exclusive and pair[0] == least):
        bound = f"be above {least:g}" if exclusive else "not be negative"
        raise InputError(f"randomisation range {name} must {bound}, got {pair}")


def _least(name: str) -> tuple[float, bool]:
    """Return the smallest value that a randomisation range may contain, in its unit, and whether it is itself excluded.

    name: the range's field in `RandomizationCfg`.
    """
    if name == "base_mass":
        return -load_description().links[0].mass, True
    if name in ("link_mass", "gains", "damping_gains", "no_load_speed", "cutoff_speed", "armature", "push_interval"):
        return 0.0, True
    return -math.inf, False
