"""Gravitational acceleration of planets, and the range that simulations allow."""

from __future__ import annotations

from numbers import Real

from jumper_warp.utils.errors import InputError

EARTH = 9.81  # [m/s^2]
MARS = 3.71  # [m/s^2]
MAX_GRAVITY = 100.0  # [m/s^2] four times Jupiter's


def check_gravity(gravity: float) -> None:
    """Raise InputError unless the downward gravity [m/s^2] of a simulation is in 0 to MAX_GRAVITY."""
    if not isinstance(gravity, Real) or not 0.0 <= gravity <= MAX_GRAVITY:
        raise InputError(f"gravity must lie in 0 to {MAX_GRAVITY:g} m/s^2, downward, got {gravity!r:.40}")
