"""Closed-form kinematics of the four legs in NumPy, for programs that run on the robot.

Batched over leading dimensions (...). Legs are FL, FR, BL, BR; motors of a leg lateral, outer, inner. Vectors are in
the body frame (x forward, y left, z up). `jumper_warp.kernels.kinematics` has the same formulas for the simulation.
"""

from __future__ import annotations

from typing import Any

import numpy as np

FRONT = np.array([1.0, 1.0, -1.0, -1.0])
SIDE = np.array([1.0, -1.0, 1.0, -1.0])
HIP = np.stack([FRONT * 0.1433, SIDE * np.array([0.105, 0.105, 0.150, 0.150]), np.zeros(4)], axis=1)  # [m] (4, 3)
AXIS_X = FRONT[:, None] * [0.1417, 0.0517]  # [m] axes of outer and inner thigh, housing frame
PLANE_Y = SIDE * (0.05945 + 0.00075)  # [m] ankle, housing frame
THIGH = 0.175  # [m]
SHANK = 0.300  # [m]
PAW_RADIUS = 0.025  # [m] sphere centred at the ankle
OUTWARD = FRONT[:, None] * [1.0, -1.0]  # direction of outer and inner knee at positive angles
INNER = np.array([0.0, 1.0])
ACROSS = np.array([-1j, 1j])  # turns a vector along the other shank to one across it


def legs(q: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return ankle positions [m], their Jacobians [m/rad] and those of the paws' rotation [1], at angles q [rad].

    q: (..., 12). Shapes (..., 4, 3), (..., 4, 3, 3) twice; a Jacobian's columns are the leg's motors. A paw turns with
    its inner shank. Jacobians are large where the knees coincide, beyond the limits.
    """
    angles = q.reshape(*q.shape[:-1], 4, 3)
    sine, cosine = THIGH * np.sin(angles[..., 1:]), THIGH * np.cos(angles[..., 1:])
    # points of the leg's plane as complex numbers: x forward, z up in the housing frame; last axis outer, inner
    knee = AXIS_X + OUTWARD * sine - 1j * cosine
    knee_rate = OUTWARD * cosine + 1j * sine
    span = knee[..., 0] - knee[..., 1]
    rise = np.sqrt(np.maximum(SHANK**2 / np.maximum((span * span.conj()).real, 1.0e-8) - 0.25, 0.0))
    ankle = 0.5 * (knee[..., 0] + knee[..., 1]) - 1j * FRONT * rise * span
    shank = (ankle[..., None] - knee) / SHANK  # unit vectors
    det = (shank[..., 0].conj() * shank[..., 1]).imag
    det = np.copysign(np.maximum(np.abs(det), 1.0e-4), det)
    # rigid shanks: the ankle's velocity along each shank is that of its knee
    along = (shank.conj() * knee_rate).real / det[..., None]
    ankle_rate: Any = along * shank[..., ::-1] * ACROSS
    pitch = (shank[..., 1:].conj() * (knee_rate * INNER - ankle_rate)).imag / SHANK
    lateral: Any = np.exp(1j * SIDE * angles[..., 0])
    across = lateral * (PLANE_Y + 1j * ankle.imag)  # y and z
    position = np.empty(angles.shape)
    position[..., 0], position[..., 1], position[..., 2] = ankle.real, across.real, across.imag
    jacobian = np.zeros((*angles.shape, 3))
    jacobian[..., 1, 0] = -SIDE * across.imag
    jacobian[..., 2, 0] = SIDE * across.real
    jacobian[..., 0, 1:] = ankle_rate.real
    jacobian[..., 1, 1:] = -lateral.imag[..., None] * ankle_rate.imag
    jacobian[..., 2, 1:] = lateral.real[..., None] * ankle_rate.imag
    turn = np.zeros_like(jacobian)
    turn[..., 0, 0] = SIDE
    turn[..., 1, 1:] = lateral.real[..., None] * pitch
    turn[..., 2, 1:] = lateral.imag[..., None] * pitch
    return HIP + position, jacobian, turn
