"""Refusals of numbers that no setting can have, each in one line."""

from __future__ import annotations

import re
from typing import Any

import numpy as np

from jumper_warp.utils.errors import InputError

NAME = re.compile(r"[A-Za-z0-9_][A-Za-z0-9_. -]{0,99}")
"""Of tasks, terms, observation columns and joints: lists of them are joined by commas, and they name files."""
FLOAT32_MAX = 3.4028234e38
"""Beyond it, single precision is infinite, which all settings become on their way to a device."""
MOST_SEED = 2**31 - 1
"""Of the kernels' draws."""
LAST_OF_OLDER_VERSIONS = "c88f715"
"""The last commit that reads policies, tasks and runs of older versions than today's."""


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


def check_shares(what: str, **shares: float) -> None:
    """Raises ValueError: one of the shares is not in 0 to 1."""
    for name, share in shares.items():
        if not 0.0 <= share <= 1.0:
            raise InputError(f"{what} {name} must be in [0, 1], got {share}")


def check_count(name: str, value: Any) -> None:
    """Raises ValueError: the value is no whole number of at least 1."""
    if isinstance(value, bool) or not isinstance(value, int | np.integer) or value < 1:
        raise InputError(f"{name} must be a whole number of at least 1, got {value!r:.40}")


def check_seed(value: Any) -> None:
    """Raises ValueError: the value is no whole number that the kernels' draws take as a seed."""
    if isinstance(value, bool) or not isinstance(value, int | np.integer) or not 0 <= value <= MOST_SEED:
        raise InputError(f"seed must be in 0 .. {MOST_SEED}, got {value!r:.40}")


def version_error(found: str, known: int) -> str:
    """Return why a file of another version is refused, and which commit reads the older ones."""
    return f"has version {found}, this is version {known}; commit {LAST_OF_OLDER_VERSIONS} reads older ones"
