"""Gravity of planets, and its allowed range."""

from __future__ import annotations

from jumper_warp.utils.errors import InputError

EARTH = 9.81
"""[m/s^2]"""
MARS = 3.71
"""[m/s^2]"""
MOST = 100.0
"""[m/s^2] Largest allowed; four times Jupiter's."""


def check_gravity(gravity: float) -> None:
    """Raise InputError unless a gravity [m/s^2], downward, is in 0 to MOST."""
    if not 0.0 <= gravity <= MOST:
        raise InputError(f"gravity must lie in 0 to {MOST:g} m/s^2, downward, got {gravity}")
