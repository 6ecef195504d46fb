"""Closed-form kinematics of the four legs in NumPy, for programs that run on the robot.

Batched over leading dimensions (...). Legs are FL, FR, BL, BR; motors of a leg lateral, outer, inner. Vectors are in
the body frame (x forward, y left, z up). `jumper_warp.kernels.kinematics` has the same formulas for the simulation.
"""

from __future__ import annotations

import numpy as np

FRONT = np.array([1.0, 1.0, -1.0, -1.0])
SIDE = np.array([1.0, -1.0, 1.0, -1.0])
HIP = np.stack([FRONT * 0.1433, SIDE * np.array([0.105, 0.105, 0.150, 0.150]), np.zeros(4)], axis=1)  # [m] (4, 3)
OUTER_X = FRONT * 0.1417  # [m] axis of the outer thigh, housing frame
INNER_X = FRONT * 0.0517  # [m] axis of the inner thigh, housing frame
PLANE_Y = SIDE * (0.05945 + 0.00075)  # [m] ankle, housing frame
THIGH = 0.175  # [m]
SHANK = 0.300  # [m]
PAW_RADIUS = 0.025  # [m] sphere centred at the ankle


def legs(q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return ankle positions [m], (..., 4, 3), and their Jacobians [m/rad], (..., 4, 3, 3), at angles q [rad].

    q: (..., 12). Columns of a Jacobian are the leg's motors. It is large where the knees coincide, beyond the limits.
    """
    lateral, outer, inner = np.moveaxis(q.reshape(*q.shape[:-1], 4, 3), -1, 0)
    outer_do = THIGH * np.stack([FRONT * np.cos(outer), np.sin(outer)], axis=-1)
    inner_di = THIGH * np.stack([-FRONT * np.cos(inner), np.sin(inner)], axis=-1)
    outer_knee = np.stack([OUTER_X + FRONT * THIGH * np.sin(outer), -THIGH * np.cos(outer)], axis=-1)
    inner_knee = np.stack([INNER_X - FRONT * THIGH * np.sin(inner), -THIGH * np.cos(inner)], axis=-1)
    span = outer_knee - inner_knee
    span_sq = np.maximum((span**2).sum(-1), 1.0e-8)
    rise = FRONT * np.sqrt(np.maximum(SHANK**2 / span_sq - 0.25, 0.0))
    ankle = 0.5 * (outer_knee + inner_knee) + rise[..., None] * np.stack([span[..., 1], -span[..., 0]], axis=-1)
    a = (ankle - outer_knee) / SHANK
    b = (ankle - inner_knee) / SHANK
    det = a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]
    det = np.where(np.abs(det) < 1.0e-4, np.copysign(1.0e-4, det), det)
    # rigid shanks: the ankle's velocity along each shank is that of its knee
    by_outer = ((a * outer_do).sum(-1) / det)[..., None] * np.stack([b[..., 1], -b[..., 0]], axis=-1)
    by_inner = ((b * inner_di).sum(-1) / det)[..., None] * np.stack([-a[..., 1], a[..., 0]], axis=-1)
    c = np.cos(lateral)
    s = SIDE * np.sin(lateral)
    arm = np.stack([ankle[..., 0], c * PLANE_Y - s * ankle[..., 1], s * PLANE_Y + c * ankle[..., 1]], axis=-1)
    columns = [SIDE[:, None] * np.stack([0.0 * c, -arm[..., 2], arm[..., 1]], axis=-1)]
    columns += [np.stack([d[..., 0], -s * d[..., 1], c * d[..., 1]], axis=-1) for d in (by_outer, by_inner)]
    return HIP + arm, np.stack(columns, axis=-1)
