"""CAN frames of the IMU and of a motion capture, and the base's state that a source of it returns.

The frames are the project's own: another IMU needs a driver that sends them. Body axes: x forward, y left, z up.
"""

from __future__ import annotations

import struct
from typing import Any, NamedTuple

import numpy as np

SENSOR_IDS = (0x101, 0x102, 0x111, 0x112, 0x113)
"""Arbitration ids on the first bus: IMU's angular velocity, its specific force; captured position, velocity, attitude.
"""
GYRO_SCALE, ACCEL_SCALE = 40.0 / 32767, 320.0 / 32767  # [rad/s], [m/s²] of a code
LENGTH_SCALE, SPEED_SCALE, QUATERNION_SCALE = 5.0e-5, 2.5e-5, 1.0 / 16383  # [m], [m/s], [1] of a code
BITS = 21  # of each component of a captured position or velocity
HALF = 1 << (BITS - 1)
MAX_AGE = 24  # Ticks without frames of the motion capture after which the state is unknown


class Estimate(NamedTuple):
    """State of the base and contacts of the paws; arrays may have a leading dimension of robots."""

    position: np.ndarray  # (3,) [m] of the base's origin, world, z = 0 the ground
    velocity: np.ndarray  # (3,) [m/s] of the base's origin, world
    quaternion: np.ndarray  # (4,) xyzw, body to world
    contact: np.ndarray  # (4,) bool, paws FL, FR, BL, BR
    diverged: np.ndarray | bool  # unknown state: NaN, no frames, or a standard deviation above 1 m/s or 0.2 rad


UNKNOWN = Estimate(np.zeros(3), np.zeros(3), np.array([0.0, 0.0, 0.0, 1.0]), np.zeros(4, bool), True)


class MotionCapture:
    """Base state measured by a motion capture; readings of IMU and motors are unused."""

    def __init__(self) -> None:
        """Start at the origin, diverged until the first frames arrive."""
        self._estimate, self._age = UNKNOWN, 0  # state, and updates since its frames

    def reset(self, *readings: Any) -> None:
        """Do nothing: the capture has no state; readings: as `Estimator.reset`."""

    def receive(self, frames: np.ndarray) -> None:
        """Take the frames of position, velocity and attitude, (3, 8) uint8."""
        self._estimate, self._age = unpack_capture(frames), 0

    def update(self, *readings: Any) -> Estimate:
        """Return the state of the newest frames, diverged if older than MAX_AGE; readings: as `Estimator.update`."""
        self._age += 1
        return self._estimate._replace(diverged=True) if self._age > MAX_AGE else self._estimate


def pack_imu(gyro: np.ndarray, accel: np.ndarray, count: int) -> list[bytes]:
    """Return the IMU's frames: three components [rad/s], [m/s²], then a counter that wraps at 65536."""
    vectors = np.stack([gyro / GYRO_SCALE, accel / ACCEL_SCALE])
    codes = np.clip(np.rint(vectors), -32767, 32767).astype(int)
    return [struct.pack("<hhhH", *row, count & 0xFFFF) for row in codes.tolist()]


def unpack_imu(frames: np.ndarray) -> tuple[np.ndarray, np.ndarray, int]:
    """Return angular velocity (3,) [rad/s], specific force (3,) [m/s²] and counter of frames (2, 8) uint8."""
    gyro, accel = np.ascontiguousarray(frames).view("<i2")
    return gyro[:3] * GYRO_SCALE, accel[:3] * ACCEL_SCALE, int(gyro[3]) & 0xFFFF


def pack_capture(
    position: np.ndarray, velocity: np.ndarray, quaternion: np.ndarray, contact: np.ndarray
) -> list[bytes]:
    """Return captured position [m], velocity [m/s] (3,), quaternion (4,) xyzw and contacts (4,) as frames.

    Components of position and velocity saturate at 2^20 codes.
    """
    vectors = np.stack([position / LENGTH_SCALE, velocity / SPEED_SCALE])
    codes = np.clip(np.rint(vectors), -HALF, HALF - 1).astype(int) + HALF
    values = [sum(code << BITS * i for i, code in enumerate(row)) for row in codes.tolist()]
    parts = np.rint(quaternion / QUATERNION_SCALE).astype(int) + 16384
    attitude = sum(part << 15 * i for i, part in enumerate(parts.tolist()))
    values.append(attitude | sum(down << (60 + leg) for leg, down in enumerate(contact.tolist())))
    return [value.to_bytes(8, "little") for value in values]


def unpack_capture(frames: np.ndarray) -> Estimate:
    """Return the state in the frames of `pack_capture`, (3, 8) uint8; diverged without a unit quaternion."""
    *vectors, attitude = (int.from_bytes(frame.tobytes(), "little") for frame in frames)
    codes = np.array([[(value >> BITS * i) % (2 * HALF) - HALF for i in range(3)] for value in vectors])
    quaternion = QUATERNION_SCALE * np.array([(attitude >> 15 * i & 0x7FFF) - 16384 for i in range(4)])
    contact = np.array([attitude >> (60 + leg) & 1 for leg in range(4)], dtype=bool)
    length = np.linalg.norm(quaternion)
    state = (codes[0] * LENGTH_SCALE, codes[1] * SPEED_SCALE, quaternion / max(length, 0.1))
    return Estimate(*state, contact, not length > 0.9)
