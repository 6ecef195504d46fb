"""Capsules and boxes for the collision library coal, the oracle of the collision tests; any common frame."""

import coal
import numpy as np
from scipy.spatial.transform import Rotation


def capsule(start, end, radius):
    """Return (shape, placement, radius) of a capsule between two points [m]; a sphere where they coincide."""
    axis = np.asarray(end) - start
    length = np.linalg.norm(axis)
    turn = Rotation.align_vectors([axis / length], [[0, 0, 1]])[0].as_matrix() if length > 0 else np.eye(3)
    return coal.Capsule(radius, length), coal.Transform3s(turn, (start + np.asarray(end)) / 2), radius


def box(low, high):
    """Return (shape, placement, radius 0) of the axis-aligned box with lowest and highest corners low, high [m]."""
    size = np.subtract(high, low)
    return coal.Box(*size), coal.Transform3s(np.eye(3), np.add(low, high) / 2), 0.0


def coal_distance(a, b):
    """Return the signed distance [m] of two (shape, placement, radius).

    It is at least minus the sum of the radii, as the kernels', which measure between the cores of rounded shapes.
    """
    result = coal.distance(a[0], a[1], b[0], b[1], coal.DistanceRequest(), coal.DistanceResult())
    return max(result, -a[2] - b[2])
