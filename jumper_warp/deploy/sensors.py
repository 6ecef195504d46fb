"""CAN frames of the IMU and of a motion capture, and the base's state that a source of it returns.

The frames are the project's own: another IMU needs its driver in `Sensors.decode`. Body axes: x forward, y left, z up.
"""

from __future__ import annotations

import struct
from typing import Any, NamedTuple, Protocol

import numpy as np

GYRO, ACCEL, POSITION, VELOCITY, ATTITUDE = SENSOR_IDS = (0x101, 0x102, 0x111, 0x112, 0x113)
"""Arbitration ids on the first bus: IMU's angular velocity, its specific force; captured position, velocity, attitude.
"""
GYRO_SCALE, ACCEL_SCALE = 40.0 / 32767, 320.0 / 32767  # [rad/s], [m/s²] of a code
LENGTH_SCALE, SPEED_SCALE, QUATERNION_SCALE = 5.0e-5, 2.5e-5, 1.0 / 16383  # [m], [m/s], [1] of a code
BITS = 21  # of each component of a captured position or velocity


class Estimate(NamedTuple):
    """State of the base and contacts of the paws; arrays may have a leading dimension of robots."""

    position: np.ndarray  # (3,) [m] of the base's origin, world, z = 0 the ground
    velocity: np.ndarray  # (3,) [m/s] of the base's origin, world
    quaternion: np.ndarray  # (4,) xyzw, body to world
    contact: np.ndarray  # (4,) bool, paws FL, FR, BL, BR
    diverged: np.ndarray | bool  # unknown state: NaN, no frames, or a standard deviation above 1 m/s or 0.2 rad


class StateSource(Protocol):
    """Source of the base's state: an estimator, or a motion capture."""

    def reset(self, gyro: np.ndarray, accel: np.ndarray, q: np.ndarray, quaternion: np.ndarray | None = None) -> None:
        """Start at rest; gyro (3,) [rad/s], accel (3,) [m/s²], q (12,) [rad], quaternion (4,) xyzw."""
        ...

    def update(
        self, gyro: np.ndarray, accel: np.ndarray, q: np.ndarray, qd: np.ndarray, torque: np.ndarray, dt: float
    ) -> Any:
        """Return the `Estimate` after dt [s]; qd: (12,) [rad/s], torque: (12,) [N m], the others as in `reset`."""
        ...


class MotionCapture:
    """Base state measured by a motion capture, whose frames `receive` takes; the other readings are unused."""

    def __init__(self) -> None:
        """Start at the origin, diverged until the first frames arrive."""
        self._estimate = Estimate(np.zeros(3), np.zeros(3), np.array([0.0, 0.0, 0.0, 1.0]), np.zeros(4, bool), True)

    def reset(self, *readings: Any) -> None:
        """Do nothing: the capture has no state; readings: as `StateSource.reset`."""

    def receive(self, frames: np.ndarray) -> None:
        """Take the frames POSITION, VELOCITY and ATTITUDE, (3, 8) uint8."""
        position = unpack_vector(frames[0].tobytes(), LENGTH_SCALE)
        velocity = unpack_vector(frames[1].tobytes(), SPEED_SCALE)
        codes = int.from_bytes(frames[2].tobytes(), "little")
        parts = np.array([(codes >> 15 * i & 0x7FFF) - 16384 for i in range(4)])
        quaternion = parts * QUATERNION_SCALE
        contact = np.array([codes >> (60 + leg) & 1 for leg in range(4)], dtype=bool)
        length = np.linalg.norm(quaternion)
        self._estimate = Estimate(position, velocity, quaternion / max(length, 0.1), contact, not length > 0.9)

    def update(self, *readings: Any) -> Estimate:
        """Return the state of the newest frames; readings: as `StateSource.update`."""
        return self._estimate


def pack_imu(vector: np.ndarray, scale: float, count: int) -> bytes:
    """Return a frame of the IMU: three components by `scale`, then a counter that wraps at 65536."""
    codes = np.clip(np.rint(np.asarray(vector) / scale), -32767, 32767).astype(int)
    return struct.pack("<hhhH", *codes, count & 0xFFFF)


def unpack_imu(data: bytes, scale: float) -> tuple[np.ndarray, int]:
    """Return vector (3,) and counter of a frame of the IMU."""
    *codes, count = struct.unpack("<hhhH", data)
    return np.array(codes) * scale, count


def pack_vector(vector: np.ndarray, scale: float) -> bytes:
    """Return a captured position or velocity (3,) as a frame; components saturate at 2^20 · scale."""
    half = 1 << (BITS - 1)
    codes = np.clip(np.rint(np.asarray(vector) / scale), -half, half - 1).astype(int) + half
    return sum(int(code) << BITS * i for i, code in enumerate(codes)).to_bytes(8, "little")


def unpack_vector(data: bytes, scale: float) -> np.ndarray:
    """Return the vector (3,) in a frame of `pack_vector`."""
    codes = int.from_bytes(data, "little")
    mask = (1 << BITS) - 1
    return np.array([((codes >> BITS * i) & mask) - (1 << (BITS - 1)) for i in range(3)]) * scale


def pack_attitude(quaternion: np.ndarray, contact: np.ndarray) -> bytes:
    """Return a quaternion (4,) xyzw and the contacts of the paws (4,) as a frame."""
    codes = np.rint(np.asarray(quaternion) / QUATERNION_SCALE).astype(int) + 16384
    value = sum(int(code) << 15 * i for i, code in enumerate(codes))
    return (value | sum(int(down) << (60 + leg) for leg, down in enumerate(contact))).to_bytes(8, "little")
