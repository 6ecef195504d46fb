"""Configurations of numbers and ranges: their checks, and conversion to the kernels' structs of equal fields."""

from __future__ import annotations

import math
from collections.abc import Collection
from typing import Any

import warp as wp

from jumper_warp.utils.checks import check_finite
from jumper_warp.utils.errors import InputError

Pair = tuple[float, float]  # (lower, upper) end of a range


def check_ranges(prefix: str, cfg: Any, skip: Collection[str] = (), not_negative: Collection[str] = ()) -> None:
    """Raise InputError: a number of a dataclass is not finite, a pair falls, or a field in `not_negative` is below 0.

    prefix: of the names in messages. skip: fields that are neither numbers nor pairs.
    """
    for name, value in vars(cfg).items():
        if name in skip:
            continue
        check_finite(f"{prefix} {name}", *(value if isinstance(value, tuple) else (value,)))
        if isinstance(value, tuple) and not value[0] <= value[1]:
            raise InputError(f"{prefix} {name} must be (lower, upper), got {value}")
        least = value[0] if isinstance(value, tuple) else value
        if name in not_negative and least < 0.0:
            raise InputError(f"{prefix} {name} must not be negative, got {least}")


def filled(struct: Any, cfg: Any, skip: Collection[str] = (), degrees: Collection[str] = ()) -> Any:
    """Return `struct`, a kernels' struct, with the fields of a dataclass written to it: numbers, and pairs as vec2.

    skip: fields to leave out; degrees: fields [deg] to convert to [rad].
    """
    for name, value in vars(cfg).items():
        if name not in skip:
            scale = math.pi / 180.0 if name in degrees else 1.0
            setattr(struct, name, wp.vec2(*(scale * v for v in value)) if isinstance(value, tuple) else scale * value)
    return struct
