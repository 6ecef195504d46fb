"""Checks of settings dataclasses of numbers and ranges, and their conversion to kernel structs with the same fields."""

from __future__ import annotations

import math
from collections.abc import Collection
from typing import Any

import warp as wp

from jumper_warp.utils.checks import MOST_SETTING, check_bounds, check_types
from jumper_warp.utils.errors import InputError
from jumper_warp.utils.kernels import KernelStruct

Pair = tuple[float, float]  # (lower, upper) end of a range


def check_ranges(prefix: str, cfg: Any, skip: Collection[str] = (), not_negative: Collection[str] = ()) -> None:
    """Raise InputError unless a settings dataclass has numbers within bounds, and (lower, upper) where it has pairs.

    Bounds: ±MOST_SETTING.
    prefix: before field names in messages. skip: fields to leave unchecked. not_negative: fields that must be >= 0.
    """
    check_types(prefix, cfg)
    for name, value in vars(cfg).items():
        if name in skip:
            continue
        check_bounds(prefix, cfg, {name: (-MOST_SETTING, MOST_SETTING, "")})
        if isinstance(value, tuple) and not value[0] <= value[1]:
            raise InputError(f"{prefix} {name} must be (lower, upper), got {value}")
        least = value[0] if isinstance(value, tuple) else value
        if name in not_negative and least < 0.0:
            raise InputError(f"{prefix} {name} must not be negative, got {least}")


def filled(
    struct: KernelStruct, cfg: object, skip: Collection[str] = (), degrees: Collection[str] = ()
) -> KernelStruct:
    """Copy the fields of a settings dataclass to a kernel struct, pairs (lower, upper) as vec2; return the struct.

    skip: fields to omit; degrees: fields [deg] to convert to [rad].
    """
    for name, value in vars(cfg).items():
        if name not in skip:
            scale = math.pi / 180.0 if name in degrees else 1.0
            setattr(struct, name, wp.vec2(*(scale * v for v in value)) if isinstance(value, tuple) else scale * value)
    return struct
