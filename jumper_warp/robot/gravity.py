"""Gravitational acceleration of planets, and the range that simulations allow."""

from __future__ import annotations

from jumper_warp.utils.checks import check_number

EARTH = 9.81  # [m/s^2]
MARS = 3.71  # [m/s^2]
MAX_GRAVITY = 100.0  # [m/s^2] four times Jupiter's


def check_gravity(gravity: float) -> None:
    """Raise InputError unless the downward gravity [m/s^2] of a simulation is in 0 to MAX_GRAVITY."""
    check_number("downward gravity", gravity, 0.0, MAX_GRAVITY, "m/s^2")
