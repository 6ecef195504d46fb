"""Initial states of recorded motions: their prior distribution, and the pose of a robot that stands on four paws.

A simulation of a recorded motion needs the state at its first row more accurately than sensors measure it, so the state
is fitted too, from a prior around the measured one. For a standing robot, contact gives more than sensors do: all paws
are on the ground. Motors: legs FL, FR, BL, BR, each lateral (positive outward), outer, inner (positive away from the
other thigh). World z is up, base axes are x ahead, y left, z up, quaternions xyzw, base to world.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from jumper_warp.identification.motions import DEGREES, NoiseLevels, RecordedMotion
from jumper_warp.robot.description import LEGS, RobotDescription, leg_dimensions
from jumper_warp.robot.folder import LOCKED
from jumper_warp.robot.values import RobotValues
from jumper_warp.utils.rotations import CONJUGATE, from_rotation_vector, multiply, rotate

HANGING_HEIGHT = 1.0  # [m] Height of a held base whose position is not measured
STEP = 1.0e-6  # [s] Time step, or [rad] angle step, of central differences of paw positions
NORMAL_WEIGHT = 1.0e3  # [1] Weight of the paws' velocities normal to the ground against those along the ground
LEVELLING_STEPS = 6  # Newton steps after which all paws lie in one plane to rounding
FIRST_ROWS = 8  # rows from which a motion's initial state is measured
QUIET_ROWS = 2
QUIET = 0.2  # [rad/s] Mean rate over the first `QUIET_ROWS` below which a standing robot has all paws on the ground
TRUST = 3.0
"""[1] Prior std of a measured initial state over the sensor's noise: large, as the same reading is also a residual."""


@dataclass
class InitialStates:
    """Poses and velocities of base and motors of N robots at the first row of a motion.

    Motors by leg FL, FR, BL, BR, each lateral, outer, inner.
    """

    position: np.ndarray  # (N, 3) [m] of the base's origin, world frame
    quaternion: np.ndarray  # (N, 4) xyzw, base to world
    velocity: np.ndarray  # (N, 3) [m/s] of the base's origin, world frame
    spin: np.ndarray  # (N, 3) [rad/s] angular velocity of the base, world frame
    angle: np.ndarray  # (N, 12) [rad] true motor angles, without sensor offsets
    rate: np.ndarray  # (N, 12) [rad/s] motor rates


class InitialStatePrior:
    """Prior distribution of the robot's state at the start of a motion, estimated from its first measured rows.

    The state has I = 27 or 36 normalised coordinates. Coordinates are deviations from the measured state, in prior
    standard deviations: 12 motor readings, 12 rates, the base's rotation vector (3), and for a free base its position,
    velocity and spin (3 each, world frame). A locked lateral axis rests at its described angle, without a sensor.
    """

    def __init__(self, motion: RecordedMotion, noise: NoiseLevels, description: RobotDescription):
        """Estimate the initial state and its standard deviations from a motion's first rows and the robot's stance."""
        self.free = motion.base == "free"
        self.description = description
        self.size = 36 if self.free else 27  # Number I of coordinates
        rows = min(FIRST_ROWS, len(motion.time))
        angle_noise = DEGREES * noise.angle
        rate_noise = DEGREES * noise.rate
        angle, angle_std = first_values(motion.angle, motion.target[0], TRUST * angle_noise, 10.0 * DEGREES)
        rate, rate_std = first_values(motion.rate, np.zeros(12), TRUST * rate_noise, 1.0)
        if motion.rate is None and motion.angle is not None:
            rate = column_slopes(motion.time[:rows], motion.angle[:rows])
            rate_std = np.full(12, 1.0)
        self.locked = [i for i, motor in enumerate(description.motors) if motor == LOCKED]
        angle[self.locked] = description.poses["default"][0]
        rate[self.locked] = 0.0
        level = np.array([0.0, 0.0, 0.0, 1.0])
        position = np.array([0.0, 0.0, HANGING_HEIGHT])
        quaternion, _ = first_values(motion.quaternion, level, 0.0, 0.0)
        quaternion = quaternion / np.linalg.norm(quaternion)
        tilt_std = np.full(3, math.radians(2.0 if motion.quaternion is not None else 5.0))
        velocity = np.zeros(3)
        base_std = []
        self.standing = self.resting = False
        if self.free:
            ground = stance(description, angle[None], rate[None])
            position[2] = ground.height[0]
            position, position_std = first_values(motion.position, position, 0.02, 0.05)
            up = rotate(quaternion * CONJUGATE, np.array([0.0, 0.0, 1.0]))
            height_fits = abs(position[2] - ground.height[0]) < 0.03
            near = height_fits and float(up @ ground.up[0]) > math.cos(math.radians(6.0))
            self.standing = near and ground.gap[0] < 0.02
            if motion.position is not None:
                velocity = column_slopes(motion.time[:rows], motion.position[:rows])
            base_std = [position_std, np.full(3, 0.3), np.full(3, 1.0)]
            if self.standing:  # contact constrains the base better than its sensors do
                tilt_std = np.array([0.2 * DEGREES, 0.2 * DEGREES, tilt_std[2]])
                base_std = [np.array([0.02, 0.02, 0.001]), np.full(3, 0.05), np.full(3, 0.3)]
                self.resting = motion.rate is not None and motors_at_rest(np.delete(motion.rate, self.locked, axis=1))
                self._levelling = levelling_direction(description, angle)
        mean = (position, quaternion, velocity, np.zeros(3), angle, rate)
        self._mean = InitialStates(*(values[None] for values in mean))
        self._std = np.concatenate([angle_std, rate_std, tilt_std, *base_std])

    def states(self, z: np.ndarray, robots: RobotValues) -> InitialStates:
        """Convert normalised coordinates z (N, I) of the initial state to poses and velocities of N robots.

        True angles are readings minus offsets. A standing robot's base is placed so that all paws are on the ground;
        its base coordinates are added afterwards.
        """
        mean = self._mean
        deviation = z * self._std
        state = InitialStates(*(np.repeat(getattr(mean, name), len(z), axis=0) for name in vars(mean)))
        state.angle = state.angle + deviation[:, :12] - robots.offset
        state.rate = state.rate + deviation[:, 12:24]
        if self.resting:
            state.angle, state.rate = levelled(self.description, state.angle, state.rate, self._levelling)
        if self.standing:
            ground = stance(self.description, state.angle, state.rate)
            up = rotate(state.quaternion, ground.up)  # rotated to the vertical, about a level axis
            half = np.stack([up[:, 1], -up[:, 0], np.zeros(len(z)), 1.0 + up[:, 2]], axis=1)
            state.quaternion = multiply(half / np.linalg.norm(half, axis=1, keepdims=True), state.quaternion)
            state.position[:, 2] = ground.height
            state.velocity, state.spin = (rotate(state.quaternion, v) for v in (ground.velocity, ground.spin))
        state.quaternion = multiply(from_rotation_vector(deviation[:, 24:27]), state.quaternion)
        if self.free:
            state.position = state.position + deviation[:, 27:30]
            state.velocity = state.velocity + deviation[:, 30:33]
            state.spin = state.spin + deviation[:, 33:36]
        return state


def motors_at_rest(rate: np.ndarray) -> bool:
    """Return whether all motors are at rest, by their mean rates over the first `QUIET_ROWS` of rates (n, motors).

    At rest: below `QUIET` [rad/s]. False if a motor has no rates in these rows.
    """
    if np.isnan(rate[:QUIET_ROWS]).all(axis=0).any():
        return False
    return bool((np.abs(np.nanmean(rate[:QUIET_ROWS], axis=0)) < QUIET).all())


def first_values(
    values: np.ndarray | None, default: np.ndarray, measured_std: float, default_std: float
) -> tuple[np.ndarray, np.ndarray]:
    """Return the first measured value of each column and its standard deviation, or defaults where nothing is measured.

    (columns,) each. values: (n, columns), NaN where not measured, or None; only the first `FIRST_ROWS` count. default:
    (columns,).
    """
    if values is None:
        return default.copy(), np.full(len(default), default_std)
    first = default.copy()
    measured = np.isfinite(values[:FIRST_ROWS]).any(axis=0)
    for i in np.flatnonzero(measured):
        column = values[:FIRST_ROWS, i]
        first[i] = column[np.isfinite(column)][0]
    return first, np.where(measured, measured_std, default_std)


def column_slopes(time: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Return the least-squares slope [1/s] of each column of values (n, columns) over time (n,) [s].

    0 where fewer than three values are measured (not NaN).
    """
    slopes = np.zeros(values.shape[1])
    for i in range(values.shape[1]):
        measured = np.isfinite(values[:, i])
        if measured.sum() >= 3:
            slopes[i] = np.polyfit(time[measured] - time[0], values[measured, i], 1)[0]
    return slopes


class Stance(NamedTuple):
    """Pose and velocity of N robots' bases whose four paws rest on the ground."""

    height: np.ndarray  # (N,) [m] of the base's origin above the ground
    up: np.ndarray  # (N, 3) unit vector of world z, base frame
    gap: np.ndarray  # (N,) [m] largest distance of a paw from the least-squares plane through the four paws
    velocity: np.ndarray  # (N, 3) [m/s] of the base's origin, base frame, which minimises the paws' velocities
    spin: np.ndarray  # (N, 3) [rad/s] of the base, base frame, which minimises the paws' velocities


def paw_positions(description: RobotDescription, angle: np.ndarray) -> np.ndarray:
    """Return the paws' centres [m], base frame, (N, 4 legs FL, FR, BL, BR, 3), at motor angles (N, 12) [rad].

    In the leg's plane the ankle is one shank away from each knee, on their lower side: off the middle of the knees by
    `skew` times their difference, and by `rise` times this difference, turned by 90 degrees. The inner shank extends
    beyond the ankle to the paw. The lateral motor then turns the plane about body x. Where the knees are too far apart
    for the five-bar to close, the ankle is on the line between them.
    """
    paws = np.zeros((len(angle), 4, 3))
    for k, name in enumerate(LEGS):
        leg = leg_dimensions(description, name)
        lateral = angle[:, 3 * k]
        outer = angle[:, 3 * k + 1]
        inner = angle[:, 3 * k + 2]
        outer_x = leg.outer_x + leg.front * leg.thigh * np.sin(outer)
        outer_z = -leg.thigh * np.cos(outer)
        inner_x = leg.inner_x - leg.front * leg.thigh * np.sin(inner)
        inner_z = -leg.thigh * np.cos(inner)
        across = outer_x - inner_x
        up = outer_z - inner_z
        distance = np.maximum(np.hypot(across, up), 1.0e-6)
        skew = 0.5 * (leg.shank**2 - leg.outer_shank**2) / distance**2
        rise = np.sqrt(np.maximum(leg.shank**2 - (0.25 + skew + skew**2) * distance**2, 1.0e-9)) / distance
        ankle_x = 0.5 * (outer_x + inner_x) + skew * across + leg.front * rise * up
        ankle_z = 0.5 * (outer_z + inner_z) + skew * up - leg.front * rise * across
        extension = leg.paw_offset / leg.shank
        x = ankle_x + extension * (ankle_x - inner_x)
        z = ankle_z + extension * (ankle_z - inner_z)
        y = leg.plane_y + leg.knee_y
        sine = leg.side * np.sin(lateral)
        cosine = np.cos(lateral)
        paws[:, k] = np.array(leg.hip) + np.stack([x, cosine * y - sine * z, sine * y + cosine * z], axis=1)
    return paws


def stance(description: RobotDescription, angle: np.ndarray, rate: np.ndarray) -> Stance:
    """Compute pose and velocity of bases whose paws rest on level ground; angle [rad], rate [rad/s]: (N, 12).

    The ground is the least-squares plane through the paws' centres, a paw radius below them. The base's twist is the
    one with which paws at `rate` move least, normal to the ground above all.
    """
    paws = paw_positions(description, angle)
    ahead, behind = (paw_positions(description, angle + sign * STEP * rate) for sign in (1.0, -1.0))
    paw_velocity = (ahead - behind) / (2 * STEP)
    radius = leg_dimensions(description, LEGS[0]).paw_radius
    design = np.concatenate([paws[..., :2], np.ones((*paws.shape[:2], 1))], axis=2)
    plane = np.linalg.solve(np.swapaxes(design, 1, 2) @ design, np.swapaxes(design, 1, 2) @ paws[..., 2:])[..., 0]
    size = np.sqrt(1.0 + plane[:, 0] ** 2 + plane[:, 1] ** 2)
    up = np.stack([-plane[:, 0], -plane[:, 1], np.ones(len(plane))], axis=1) / size[:, None]
    distance = np.einsum("nki,ni->nk", paws, up) - (plane[:, 2] / size)[:, None]
    points = paws - radius * up[:, None]
    cross = np.zeros((*paws.shape[:2], 3, 6))
    cross[..., :3] = np.eye(3)
    # v + spin x p: columns of the spin are axis x p
    for i in range(3):
        cross[..., 3 + i] = np.cross(np.eye(3)[i], points)
    # the velocity off the ground counts most
    frame = np.eye(3) + NORMAL_WEIGHT * up[:, :, None] * up[:, None]
    cross = frame[:, None] @ cross
    paw_velocity = np.einsum("nij,nkj->nki", frame, paw_velocity)
    rows = cross.reshape(len(paws), 12, 6)
    target = -paw_velocity.reshape(len(paws), 12, 1)
    twist = np.linalg.solve(np.swapaxes(rows, 1, 2) @ rows, np.swapaxes(rows, 1, 2) @ target)[..., 0]
    return Stance(radius - plane[:, 2] / size, up, np.abs(distance).max(axis=1), twist[:, :3], twist[:, 3:])


def unevenness(description: RobotDescription, angle: np.ndarray) -> np.ndarray:
    """Return the signed distance [m] (N,) of paw BR from the plane of the other three, at motor angles (N, 12) [rad].

    Positive along (FR - FL) x (BL - FL), which points down. Only at 0 do all four paws stand.
    """
    paws = paw_positions(description, angle)
    to_fr, to_bl, to_br = (paws[:, k] - paws[:, 0] for k in (1, 2, 3))
    normal = np.cross(to_fr, to_bl)
    return np.einsum("ni,ni->n", to_br, normal) / np.linalg.norm(normal, axis=1)


def levelling_direction(description: RobotDescription, angle: np.ndarray) -> np.ndarray:
    """Return the smallest motor motion, (12,) [rad/m], that moves a paw from the plane of the others (`unevenness`).

    It is the gradient over its squared norm, along which the correction `levelled` is least. Locked axes do not move.
    angle: (12,) [rad].
    """
    ahead, behind = (unevenness(description, angle + sign * STEP * np.eye(12)) for sign in (1.0, -1.0))
    slope = (ahead - behind) / (2.0 * STEP)
    slope[[motor == LOCKED for motor in description.motors]] = 0.0
    return slope / (slope @ slope)


def levelled(
    description: RobotDescription, angle: np.ndarray, rate: np.ndarray, direction: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Correct motor angles [rad] and rates [rad/s], (N, 12), so that all paws lie and stay in one plane.

    A paw off the ground by micrometres would strike it at a random time.
    direction: of the correction of angles and rates, (12,) [rad/m], from `levelling_direction`.
    """
    for _ in range(LEVELLING_STEPS):
        angle = angle - unevenness(description, angle)[:, None] * direction
    ahead, behind = (unevenness(description, angle + sign * STEP * rate) for sign in (1.0, -1.0))
    plus, minus = (unevenness(description, angle + sign * STEP * direction) for sign in (1.0, -1.0))
    return angle, rate - (0.5 * (ahead - behind) / ((plus - minus) / 2.0))[:, None] * direction
