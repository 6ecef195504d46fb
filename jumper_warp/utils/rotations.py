"""Rotations in NumPy: unit quaternions xyzw, rotation vectors (axis times angle [rad]), and angles about z."""

from __future__ import annotations

import numpy as np

CONJUGATE = np.array([-1.0, -1.0, -1.0, 1.0])
"""(4,) Factors on a quaternion xyzw that give its conjugate, which is the inverse of a unit quaternion."""


def rotate(quaternion: np.ndarray, vector: np.ndarray) -> np.ndarray:
    """Return vectors (..., 3) rotated by quaternions xyzw (..., 4)."""
    axis = quaternion[..., :3]
    w = quaternion[..., 3:]
    return vector + 2.0 * np.cross(axis, np.cross(axis, vector) + w * vector)


def multiply(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return the product a b of quaternions xyzw, each (..., 4): the rotation by b, then by a."""
    vector = a[..., 3:] * b[..., :3] + b[..., 3:] * a[..., :3] + np.cross(a[..., :3], b[..., :3])
    scalar = a[..., 3:] * b[..., 3:] - np.sum(a[..., :3] * b[..., :3], axis=-1, keepdims=True)
    return np.concatenate([vector, scalar], axis=-1)


def from_rotation_vector(vector: np.ndarray) -> np.ndarray:
    """Return the quaternions xyzw (..., 4) of rotation vectors (..., 3) [rad]."""
    angle = np.linalg.norm(vector, axis=-1, keepdims=True)
    return np.concatenate([0.5 * np.sinc(0.5 * angle / np.pi) * vector, np.cos(0.5 * angle)], axis=-1)


def to_rotation_vector(quaternion: np.ndarray) -> np.ndarray:
    """Return the rotation vectors (..., 3) [rad] of quaternions xyzw (..., 4), of length at most π."""
    quaternion = quaternion * np.where(quaternion[..., 3:] < 0.0, -1.0, 1.0)
    sine = np.linalg.norm(quaternion[..., :3], axis=-1, keepdims=True)
    angle = 2.0 * np.arctan2(sine, quaternion[..., 3:])
    return quaternion[..., :3] * np.where(sine > 1.0e-12, angle / np.maximum(sine, 1.0e-12), 2.0)


def yaw_of(quaternion: np.ndarray) -> np.ndarray:
    """Return the yaw [rad], (...), of quaternions xyzw (..., 4): angle of body x in the world plane, from world x."""
    x, y, z, w = np.moveaxis(quaternion, -1, 0)
    return np.arctan2(2.0 * (x * y + w * z), 1.0 - 2.0 * (y * y + z * z))


def turn_plane(vector: np.ndarray, angle: np.ndarray) -> np.ndarray:
    """Return vectors x, y (..., 2) turned by angles [rad], (...), about z."""
    (x, y) = np.moveaxis(vector, -1, 0)
    cos = np.cos(angle)
    sin = np.sin(angle)
    return np.stack([cos * x - sin * y, sin * x + cos * y], axis=-1)
