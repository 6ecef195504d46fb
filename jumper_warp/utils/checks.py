"""Refusals of numbers that no setting can have, each in one line."""

from __future__ import annotations

import numpy as np

from jumper_warp.utils.errors import InputError

FLOAT32_MAX = 3.4028234e38
"""Beyond it, single precision is infinite, which all settings become on their way to a device."""


def check_finite(name: str, *values: float) -> None:
    """Raises ValueError: one of the values is NaN, infinite, or so in single precision."""
    for value in values:
        if not abs(value) <= FLOAT32_MAX:
            raise InputError(f"{name} must be finite, got {value}")


def check_positive(name: str, *values: float) -> None:
    """Raises ValueError: one of the values is not above 0, or not finite."""
    for value in values:
        if not 0.0 < value <= FLOAT32_MAX:
            raise InputError(f"{name} must be positive and finite, got {value}")


def check_not_negative(name: str, *values: float) -> None:
    """Raises ValueError: one of the values is below 0, or not finite."""
    for value in values:
        if not 0.0 <= value <= FLOAT32_MAX:
            raise InputError(f"{name} must be finite and not negative, got {value}")


def check_within(name: str, values: np.ndarray, bounds: tuple[float, float]) -> None:
    """Raises ValueError: one of the values is not within the bounds, or NaN."""
    outside = ~((values >= bounds[0]) & (values <= bounds[1]))
    if outside.any():
        raise InputError(f"{name} must be in [{bounds[0]:g}, {bounds[1]:g}], got {values[outside][0]:g}")
