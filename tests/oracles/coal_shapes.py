"""Capsules and boxes for the collision library coal, the oracle of the collision tests."""

import coal
import numpy as np
from scipy.spatial.transform import Rotation


def capsule(start, end, radius):
    """Return (shape, placement, radius) of a capsule [m]; a sphere where the ends coincide."""
    axis = np.asarray(end) - start
    length = np.linalg.norm(axis)
    turn = Rotation.align_vectors([axis / length], [[0, 0, 1]])[0].as_matrix() if length > 0 else np.eye(3)
    return coal.Capsule(radius, length), coal.Transform3s(turn, (start + np.asarray(end)) / 2), radius


def box(low, high):
    """Return (shape, placement, 0) of an axis-aligned box with these corners [m]."""
    size = np.subtract(high, low)
    return coal.Box(*size), coal.Transform3s(np.eye(3), np.add(low, high) / 2), 0.0


def coal_distance(a, b):
    """Signed distance [m], not below minus the sum of the radii."""
    result = coal.distance(a[0], a[1], b[0], b[1], coal.DistanceRequest(), coal.DistanceResult())
    return max(result, -a[2] - b[2])
