"""Randomisation ranges of a task for a robot overlay, whose values differ from the robot description.

Each sampled parameter varies around the overlay's value by as much as the task's range varies around the described
value: factors and additive ranges apply to the overlay's value, and the absolute ranges in `MOVED` are moved by the
difference of overlay and description, and cut off at 0. A range of the overlay replaces the task's; it is not moved.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from jumper_warp.robot.overlay import RANDOMIZED, RobotOverlay
from jumper_warp.robot.values import RobotValues
from jumper_warp.tasks.cfg import TaskCfg
from jumper_warp.tasks.randomization import LONGEST_LATENCY, fixed_ranges
from jumper_warp.utils.errors import InputError

MOVED = {
    "motor_friction": "motor_friction",
    "dynamic_friction": "paw_friction",
    "static_friction": "paw_friction",
    "latency": "latency",
}
"""Quantity of an overlay by the absolute range of `RandomizationCfg` that follows it."""
MS = 1.0e3  # [ms/s]
UNITS = {
    "base_mass": "kg", "com_shift": "m", "motor_friction": "N m", "joint_offset": "deg", "latency": "ms",
    "observation_latency": "ms", "push_force": "N", "push_torque": "N m", "push_interval": "s",
}  # fmt: skip
"""Units of the ranges of `RandomizationCfg`; others have none."""


class RangeMoves(NamedTuple):
    """Offsets by which a robot overlay shifts absolute randomisation ranges: its values minus the described ones."""

    motor_friction: tuple[float, ...] = 12 * (0.0,)  # [N m]
    dynamic_friction: float = 0.0  # [1]
    static_friction: float = 0.0  # [1]
    latency: float = 0.0  # [ms]
    zero_latency: float = 0.0
    """[ms] Latency that is sampled with `zero_latency_probability`: the overlay's value, within its own range."""


def moves_of(overlay: RobotOverlay | None) -> RangeMoves:
    """Return the offsets by which an overlay shifts randomisation ranges; 0 where it has no value, or its own range."""
    if overlay is None:
        return RangeMoves()
    described = vars(RobotValues.nominal(1, overlay.description))
    own = overlay.randomization
    moves = {}
    for name, quantity in MOVED.items():
        if quantity in overlay.values and name not in own:
            pairs = zip(overlay.values[quantity], described[quantity][0], strict=True)
            scale = MS if name == "latency" else 1.0
            differences = tuple(scale * (value - float(usual)) for value, usual in pairs)
            moves[name] = differences if name == "motor_friction" else differences[0]
    nominal = MS * (overlay.latency or 0.0)
    lower, upper = own.get("latency", (nominal, nominal))
    return RangeMoves(**moves, zero_latency=min(max(nominal, lower), upper))


def with_own_ranges(task: TaskCfg, overlay: RobotOverlay | None) -> TaskCfg:
    """Return a copy of a task with a robot overlay's own ranges of randomisation in place of the task's.

    Raises InputError: a range is invalid, also where it is moved to the overlay's value.
    """
    if overlay is None:
        return task
    ranges = replace(task.randomization, **overlay.randomization)
    latency = ranges.latency
    if latency is not None and latency[1] + (move := moves_of(overlay).latency) > LONGEST_LATENCY:
        raise InputError(
            f"robot overlay: latency of {move:g} ms and the range {list(latency)} ms around it exceed "
            f"{LONGEST_LATENCY:g} ms: give the overlay a range"
        )
    least = (ranges.base_mass or (0.0, 0.0))[0]
    mass = float(overlay.robots().base_mass[0, 0])
    if least <= -mass:
        raise InputError(f"randomisation range base_mass must be above {-mass:g} kg for this robot, got {least:g}")
    return replace(task, randomization=ranges)


def ranges_of(task: TaskCfg, overlay: RobotOverlay | None) -> dict[str, Any]:
    """Return a task's randomisation ranges [lower, upper] for a robot overlay, by field and in its unit.

    Ranges that are off are left out.
    Motors with different friction have a list of 12 ranges. Errors: as `with_own_ranges`.
    """
    ranges = with_own_ranges(task, overlay).randomization
    moves = moves_of(overlay)._asdict()
    result: dict[str, Any] = {}
    for name in RANDOMIZED:
        if (pair := getattr(ranges, name)) is not None:
            by_motor = moves[name] if name == "motor_friction" else (moves.get(name, 0.0),)
            each = [[max(end + move, 0.0) if name in MOVED else end for end in pair] for move in by_motor]
            result[name] = each[0] if all(other == each[0] for other in each) else each
    return result


def range_words(task: TaskCfg, overlay: RobotOverlay | None, *, changed: bool = False) -> list[str]:
    """Return a task's randomisation ranges for a robot overlay as texts, such as "latency 5 to 21 ms".

    Where motors differ, a text is over all of them.
    changed: only ranges that the overlay moves or replaces.
    """
    words = []
    usual = ranges_of(task, None)
    for name, value in ranges_of(task, overlay).items():
        if not changed or value != usual.get(name):
            ends = np.ravel(value)
            words.append(f"{name} {ends.min():.4g} to {ends.max():.4g} {UNITS.get(name, '')}".rstrip())
    return words


def with_flagged_ranges(
    task: TaskCfg, flagged: TaskCfg, overlay: RobotOverlay, names: Collection[str]
) -> tuple[TaskCfg, RobotOverlay]:
    """Return a task and a robot overlay in which the randomisation ranges `names` are those that a user has set.

    flagged: the task with the user's ranges. names: of these ranges. An absolute range of the user is the overlay's
    own, so that it is not moved.
    """
    own = {name: pair for name, pair in overlay.randomization.items() if name not in names}
    absolute = {name: pair for name in names if name in MOVED and (pair := getattr(flagged.randomization, name))}
    usual = {name: getattr(task.randomization, name) for name in absolute}
    task = replace(flagged, randomization=replace(flagged.randomization, **usual))
    return task, replace(overlay, randomization=own | absolute)


def with_fixed_ranges(
    overlay: RobotOverlay | None, fixed: Mapping[str, tuple[float, float]], *, nominal: bool
) -> RobotOverlay | None:
    """Return a robot overlay with its own randomisation ranges and those of `fixed`, which take precedence.

    nominal: drop its own ranges, and fix the friction of the paws at its value.
    fixed: (lower, upper) by field of `RandomizationCfg`.
    """
    if overlay is None:
        return None
    own: Mapping[str, tuple[float, float]] = overlay.randomization
    if nominal:  # the friction of a nominal test is a range of one value
        paws = overlay.values.get("paw_friction")
        own = {} if paws is None else fixed_ranges(friction=paws[0])
    return replace(overlay, randomization={**own, **fixed})
