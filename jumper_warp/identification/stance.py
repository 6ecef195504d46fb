"""Where the paws are, and how the base stands and moves over paws that rest on the ground; many robots at once."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from jumper_warp.robot.description import LEGS, RobotDescription, leg_dimensions

HANGING_HEIGHT = 1.0
"""[m] Of a held base whose position is not measured."""
STEP = 1.0e-6
"""[rad] Of differences of paw positions."""
NORMAL_WEIGHT = 1.0e3
"""Of the paws' velocities off the ground against those along it."""
LEVELLING_STEPS = 6
"""After which paws lie in one plane to rounding."""


class Stance(NamedTuple):
    """The base over four resting paws, N robots."""

    height: np.ndarray
    """(N,) [m] Of the base's origin."""
    up: np.ndarray
    """(N, 3) World z in the base frame."""
    gap: np.ndarray
    """(N,) [m] Largest distance of a paw to the ground, if each of them is as near as it can be."""
    velocity: np.ndarray
    """(N, 3) [m/s] Of the base's origin, base frame, that lets the paws rest."""
    spin: np.ndarray
    """(N, 3) [rad/s] Likewise."""


def paw_positions(description: RobotDescription, angle: np.ndarray) -> np.ndarray:
    """Return the centres of the paws [m], base frame, (N, 4, 3), at motor angles (N, 12) [rad].

    Angles that the legs cannot have are taken to the nearest that close the loop.
    """
    found = np.zeros((len(angle), 4, 3))
    for k, name in enumerate(LEGS):
        leg = leg_dimensions(description, name)
        lateral, outer, inner = angle[:, 3 * k], angle[:, 3 * k + 1], angle[:, 3 * k + 2]
        outer_x, outer_z = leg.outer_x + leg.front * leg.thigh * np.sin(outer), -leg.thigh * np.cos(outer)
        inner_x, inner_z = leg.inner_x - leg.front * leg.thigh * np.sin(inner), -leg.thigh * np.cos(inner)
        across, up = outer_x - inner_x, outer_z - inner_z
        distance = np.maximum(np.hypot(across, up), 1.0e-6)
        rise = np.sqrt(np.maximum(leg.shank**2 - 0.25 * distance**2, 1.0e-9)) / distance
        x = 0.5 * (outer_x + inner_x) + leg.front * rise * up
        z = 0.5 * (outer_z + inner_z) - leg.front * rise * across
        y = leg.plane_y + leg.knee_y
        sine, cosine = leg.side * np.sin(lateral), np.cos(lateral)
        found[:, k] = np.array(leg.hip) + np.stack([x, cosine * y - sine * z, sine * y + cosine * z], axis=1)
    return found


def stance(description: RobotDescription, angle: np.ndarray, rate: np.ndarray) -> Stance:
    """Return the base over paws that rest on a level ground, at motor angles [rad] and rates [rad/s], (N, 12)."""
    paws = paw_positions(description, angle)
    motion = (paw_positions(description, angle + STEP * rate) - paw_positions(description, angle - STEP * rate)) / (
        2 * STEP
    )
    radius = leg_dimensions(description, LEGS[0]).paw_radius
    design = np.concatenate([paws[..., :2], np.ones((*paws.shape[:2], 1))], axis=2)
    plane = np.linalg.solve(np.swapaxes(design, 1, 2) @ design, np.swapaxes(design, 1, 2) @ paws[..., 2:])[..., 0]
    size = np.sqrt(1.0 + plane[:, 0] ** 2 + plane[:, 1] ** 2)
    up = np.stack([-plane[:, 0], -plane[:, 1], np.ones(len(plane))], axis=1) / size[:, None]
    off = np.einsum("nki,ni->nk", paws, up) - (plane[:, 2] / size)[:, None]
    points = paws - radius * up[:, None]
    cross = np.zeros((*paws.shape[:2], 3, 6))
    cross[..., :3] = np.eye(3)
    # v + spin x p: columns of the spin are axis x p
    for i in range(3):
        cross[..., 3 + i] = np.cross(np.eye(3)[i], points)
    # that no paw leaves the ground counts most
    frame = np.eye(3) + NORMAL_WEIGHT * up[:, :, None] * up[:, None]
    cross, motion = frame[:, None] @ cross, np.einsum("nij,nkj->nki", frame, motion)
    rows, target = cross.reshape(len(paws), 12, 6), -motion.reshape(len(paws), 12, 1)
    twist = np.linalg.solve(np.swapaxes(rows, 1, 2) @ rows, np.swapaxes(rows, 1, 2) @ target)[..., 0]
    return Stance(radius - plane[:, 2] / size, up, np.abs(off).max(axis=1), twist[:, :3], twist[:, 3:])


def unevenness(description: RobotDescription, angle: np.ndarray) -> np.ndarray:
    """Return how far the fourth paw is from the plane of the others [m], (N,), at motor angles (N, 12) [rad]."""
    paws = paw_positions(description, angle)
    across, along, other = (paws[:, k] - paws[:, 0] for k in (1, 2, 3))
    normal = np.cross(across, along)
    return np.einsum("ni,ni->n", other, normal) / np.linalg.norm(normal, axis=1)


def levelling(description: RobotDescription, angle: np.ndarray) -> np.ndarray:
    """Return the least change of motor angles, (12,) [rad/m], that lowers the unevenness at angles (12,) [rad]."""
    ahead, behind = (unevenness(description, angle + sign * STEP * np.eye(12)) for sign in (1.0, -1.0))
    slope = (ahead - behind) / (2.0 * STEP)
    return slope / (slope @ slope)


def levelled(
    description: RobotDescription, angle: np.ndarray, rate: np.ndarray, change: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return motor angles [rad] and rates [rad/s], (N, 12), at which all paws lie and stay in one plane.

    change: that the angles and rates take to get there, (12,) [rad/m].
    """
    for _ in range(LEVELLING_STEPS):
        angle = angle - unevenness(description, angle)[:, None] * change
    ahead, behind = (unevenness(description, angle + sign * STEP * rate) for sign in (1.0, -1.0))
    slope = (unevenness(description, angle + STEP * change) - unevenness(description, angle - STEP * change)) / 2.0
    return angle, rate - (0.5 * (ahead - behind) / slope)[:, None] * change
