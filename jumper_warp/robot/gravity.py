"""Gravity of the worlds that robots stand on."""

from __future__ import annotations

from jumper_warp.utils.errors import InputError

EARTH = 9.81
"""[m/s^2] Downward, like all here."""
MARS = 3.71
MOST = 100.0
"""Four times that of Jupiter."""


def check_gravity(gravity: float) -> None:
    """Raises ValueError: a gravity [m/s^2] is not in 0 to MOST."""
    if not 0.0 <= gravity <= MOST:
        raise InputError(f"gravity must lie in 0 to {MOST:g} m/s^2, downward, got {gravity}")
