"""Ranges of starts, goals and grounds as data: checks, and the kernels' structs with the same fields."""

from __future__ import annotations

import math
from collections.abc import Collection
from typing import Any

import warp as wp

from jumper_warp.utils.checks import check_finite
from jumper_warp.utils.errors import InputError

Pair = tuple[float, float]
"""Lower and upper end."""


def check_ranges(what: str, cfg: Any, skip: Collection[str] = (), not_negative: Collection[str] = ()) -> None:
    """Raise InputError: a number of a dataclass is not finite, a pair falls, or one of `not_negative` is below 0.

    skip: fields that are neither numbers nor pairs.
    """
    for name, value in vars(cfg).items():
        if name in skip:
            continue
        check_finite(f"{what} {name}", *(value if isinstance(value, tuple) else (value,)))
        if isinstance(value, tuple) and not value[0] <= value[1]:
            raise InputError(f"{what} {name} must be (lower, upper), got {value}")
        least = value[0] if isinstance(value, tuple) else value
        if name in not_negative and least < 0.0:
            raise InputError(f"{what} {name} must not be negative, got {least}")


def filled(struct: Any, cfg: Any, skip: Collection[str] = (), degrees: Collection[str] = ()) -> Any:
    """Return a kernels' struct with the numbers and pairs of a dataclass; skip: fields that it has not as they are.

    degrees: fields in degrees, which become radians.
    """
    for name, value in vars(cfg).items():
        if name not in skip:
            scale = math.pi / 180.0 if name in degrees else 1.0
            setattr(struct, name, wp.vec2(*(scale * v for v in value)) if isinstance(value, tuple) else scale * value)
    return struct
