"""Angles of the base about the vertical."""

from __future__ import annotations

import numpy as np


def yaw_of(quat: np.ndarray) -> np.ndarray:
    """Return the yaw [rad] of orientations (..., 4), xyzw: the heading of body x in the world plane."""
    x, y, z, w = np.moveaxis(quat, -1, 0)
    return np.arctan2(2.0 * (x * y + w * z), 1.0 - 2.0 * (y * y + z * z))


def wrapped(angle: np.ndarray) -> np.ndarray:
    """Return angles [rad] within -pi..pi."""
    return np.arctan2(np.sin(angle), np.cos(angle))
