"""Contact-aided right-invariant filter: base position, velocity and orientation from IMU, joints and motor torques.

The error is X = exp(xi) X_hat, in the world frame (z up): rotation, velocity, position, four ankles, gyro and
accelerometer bias. `docs/explanation/estimator.md` derives the equations. All arrays may have a leading dimension of
robots. The base frame's origin is the position, and the IMU's axes and place are the base frame's.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from jumper_warp.deploy.kinematics import PAW_RADIUS, legs

ROT, VEL, POS, FEET, GYRO, ACCEL = (slice(a, b) for a, b in ((0, 3), (3, 6), (6, 9), (9, 21), (21, 24), (24, 27)))
SIZE = 27
GRAVITY = np.array([0.0, 0.0, -9.81])  # [m/s^2]
FREE = 1.0  # [m] Standard deviation of the ankle of a leg without contact
HISTORY = 240  # Updates for which positions are kept for delayed fixes


@dataclass(frozen=True)
class EstimatorCfg:
    """Noise densities, initial standard deviations and thresholds of the filter."""

    gyro_noise: float = 2.0e-3  # [rad/s/√Hz]
    accel_noise: float = 2.0e-2  # [m/s^2/√Hz]
    gyro_walk: float = 1.0e-4  # [rad/s^2/√Hz]
    accel_walk: float = 1.0e-3  # [m/s^3/√Hz]
    slip: float = 0.02  # [m/√s] Random walk of an ankle in contact
    leg_noise: float = 2.0e-3  # [m] Ankle position from joint angles, per axis
    start_tilt: float = 0.01  # [rad]
    start_height: float = 0.005  # [m]
    gyro_bias: float = 0.02  # [rad/s] At the start
    accel_bias: float = 0.05  # [m/s^2] At the start
    force: float = 20.0  # [N] Least vertical paw force of a contact
    speed: float = 0.6  # [m/s] Largest ankle speed of a contact
    still: float = 0.3  # [m/s] Largest ankle speed of a contact without motor torque, as on hard stops
    support: float = 5.0  # [m/s^2] Least filtered vertical specific force of such a contact
    support_time: float = 0.03  # [s] Time constant of that filter
    gate: float = 5.0  # [1] Innovation in standard deviations beyond which a foot is anchored again
    fix_position: float = 0.005  # [m] Noise of external positions
    fix_rotation: float = 0.01  # [rad] Noise of external orientations


class Estimate(NamedTuple):
    """State of the base; each array has the leading dimension of the measurements."""

    position: np.ndarray  # (3,) [m] world
    velocity: np.ndarray  # (3,) [m/s] of the base frame's origin, world
    quaternion: np.ndarray  # (4,) xyzw, body to world
    contact: np.ndarray  # (4,) bool, FL, FR, BL, BR
    diverged: np.ndarray  # bool: NaN, or a standard deviation above 1 m/s or 0.2 rad


def skew(v: np.ndarray) -> np.ndarray:
    """Return the matrices (..., 3, 3) of the cross products with vectors v (..., 3)."""
    matrix = np.zeros((*v.shape, 3))
    matrix[..., 0, 1] = -v[..., 2]
    matrix[..., 0, 2] = v[..., 1]
    matrix[..., 1, 2] = -v[..., 0]
    return matrix - np.swapaxes(matrix, -1, -2)


def rotation(vector: np.ndarray) -> np.ndarray:
    """Return the matrices (..., 3, 3) of rotation vectors (..., 3) [rad]."""
    angle = np.linalg.norm(vector, axis=-1)[..., None, None]
    cross = skew(vector)
    return np.eye(3) + np.sinc(angle / np.pi) * cross + 0.5 * np.sinc(angle / (2.0 * np.pi)) ** 2 * cross @ cross


def quaternion_of(matrix: np.ndarray) -> np.ndarray:
    """Return the quaternions (..., 4), xyzw, of rotation matrices (..., 3, 3)."""
    m = matrix
    trace = np.trace(m, axis1=-2, axis2=-1)[..., None]
    diagonal = np.diagonal(m, axis1=-2, axis2=-1)
    # rows of 4 q q^T; the longest is the best conditioned
    outer = np.empty((*m.shape[:-2], 4, 4))
    outer[..., :3, :3] = m + np.swapaxes(m, -1, -2)
    for i in range(3):
        outer[..., i, i] = 1.0 + 2.0 * diagonal[..., i] - trace[..., 0]
        outer[..., i, 3] = outer[..., 3, i] = m[..., (i + 2) % 3, (i + 1) % 3] - m[..., (i + 1) % 3, (i + 2) % 3]
    outer[..., 3, 3] = 1.0 + trace[..., 0]
    best = np.diagonal(outer, axis1=-2, axis2=-1).argmax(-1)
    q = np.take_along_axis(outer, best[..., None, None], axis=-2)[..., 0, :]
    return q / np.linalg.norm(q, axis=-1, keepdims=True)


def matrix_of(quaternion: np.ndarray) -> np.ndarray:
    """Return the rotation matrices (..., 3, 3) of quaternions (..., 4), xyzw."""
    cross = skew(quaternion[..., :3])
    return np.eye(3) + 2.0 * quaternion[..., 3, None, None] * cross + 2.0 * cross @ cross


def level(accel: np.ndarray) -> np.ndarray:
    """Return the rotations (..., 3, 3) with zero yaw of a body at rest with specific force accel (..., 3)."""
    up = accel / np.linalg.norm(accel, axis=-1, keepdims=True)
    left = np.cross(up, [1.0, 0.0, 0.0])
    left /= np.linalg.norm(left, axis=-1, keepdims=True)
    return np.stack([np.cross(left, up), left, up], axis=-2)


class Estimator:
    """Filter of one robot, or of many with a leading dimension; call `reset` at rest, then `update` at every tick."""

    def __init__(self, cfg: EstimatorCfg | None = None) -> None:
        """Store the settings; `reset` allocates the state."""
        self.cfg = EstimatorCfg() if cfg is None else cfg

    def reset(self, gyro: np.ndarray, accel: np.ndarray, q: np.ndarray, quaternion: np.ndarray | None = None) -> None:
        """Start with a robot at rest on level ground z = 0, above the origin.

        gyro (3,) [rad/s], accel (3,) [m/s^2], q (12,) [rad]: readings at rest, best averaged over some ticks.
        quaternion: (4,) xyzw; None: tilt from accel, yaw 0.
        """
        cfg = self.cfg
        self.single = np.ndim(q) == 1
        gyro, accel, q = (np.atleast_2d(np.asarray(x, dtype=float)) for x in (gyro, accel, q))
        n = len(q)
        self.rot = level(accel) if quaternion is None else matrix_of(np.atleast_2d(quaternion))
        arms = legs(q)[0] @ np.swapaxes(self.rot, -1, -2)
        self.pos = np.zeros((n, 3))
        self.pos[:, 2] = PAW_RADIUS - arms[..., 2].mean(-1)
        self.vel = np.zeros((n, 3))
        self.feet = self.pos[:, None] + arms
        self.gyro_bias = gyro.copy()
        self.accel_bias = np.zeros((n, 3))
        self.contact = np.ones((n, 4), dtype=bool)
        self.support = np.full(n, 9.81)  # [m/s^2] filtered vertical specific force
        sigma = np.zeros(SIZE)
        sigma[ROT] = [cfg.start_tilt, cfg.start_tilt, 1.0e-4]
        sigma[VEL] = 0.01
        sigma[POS] = [1.0e-4, 1.0e-4, cfg.start_height]
        sigma[FEET] = FREE
        sigma[GYRO] = cfg.gyro_bias
        sigma[ACCEL] = cfg.accel_bias
        self.cov = np.tile(np.diag(sigma**2), (n, 1, 1))
        self.time = 0.0
        self._past: deque[tuple[float, np.ndarray]] = deque([(0.0, self.pos.copy())], maxlen=HISTORY)

    def update(
        self, gyro: np.ndarray, accel: np.ndarray, q: np.ndarray, qd: np.ndarray, torque: np.ndarray, dt: float
    ) -> Estimate:
        """Advance by dt [s] and return the estimate.

        gyro (3,) [rad/s] and accel (3,), the specific force [m/s^2], are means over dt; angles q (12,) [rad], rates qd
        (12,) [rad/s] and torques (12,) [N m] are those at its end.
        """
        gyro, accel, q, qd, torque = (np.atleast_2d(np.asarray(x, dtype=float)) for x in (gyro, accel, q, qd, torque))
        self._propagate(gyro - self.gyro_bias, accel - self.accel_bias, dt)
        ankles, jacobians = legs(q)
        arms = ankles @ np.swapaxes(self.rot, -1, -2)
        self._detect(gyro - self.gyro_bias, ankles, jacobians, qd, torque)
        self._anchor(arms)
        residual = (arms - (self.feet - self.pos[:, None])).reshape(-1, 12)
        jacobian = np.zeros((12, SIZE))
        jacobian[:, FEET] = np.eye(12)
        jacobian[:, POS] = -np.tile(np.eye(3), (4, 1))
        noise = np.where(self.contact, self.cfg.leg_noise**2, 1.0e6).repeat(3, axis=-1)
        self._correct(jacobian, residual, noise)
        self.time += dt
        self._past.append((self.time, self.pos.copy()))
        return self.estimate()

    def _propagate(self, rate: np.ndarray, force: np.ndarray, dt: float) -> None:
        """Integrate unbiased rate (n, 3) [rad/s] and specific force (n, 3) [m/s^2] over dt, with the covariance."""
        cfg = self.cfg
        middle = self.rot @ rotation(0.5 * dt * rate)
        acceleration = (middle @ force[..., None])[..., 0] + GRAVITY
        vertical = acceleration[:, 2] - GRAVITY[2]
        self.support = self.support + dt / (dt + cfg.support_time) * (vertical - self.support)
        flow = self._flow(dt)
        self.pos = self.pos + dt * self.vel + 0.5 * dt * dt * acceleration
        self.vel = self.vel + dt * acceleration
        self.rot = self.rot @ rotation(dt * rate)
        noise = np.zeros((len(rate), SIZE))
        noise[:, GYRO] = cfg.gyro_walk**2 * dt
        noise[:, ACCEL] = cfg.accel_walk**2 * dt
        noise[:, FEET] = cfg.slip**2 * dt
        # flow maps a bias error of one into the error of dt seconds of white noise
        inputs = flow[:, :, 21:27] / dt
        inputs[:, 21:27] = 0.0
        white = np.repeat([cfg.gyro_noise**2, cfg.accel_noise**2], 3) * dt
        self.cov = flow @ self.cov @ np.swapaxes(flow, -1, -2) + (inputs * white) @ np.swapaxes(inputs, -1, -2)
        self.cov[:, range(SIZE), range(SIZE)] += noise

    def _flow(self, dt: float) -> np.ndarray:
        """Return the transition matrices (n, 27, 27) of the error over dt [s], to second order for the position."""
        flow = np.tile(np.eye(SIZE), (len(self.pos), 1, 1))
        flow[:, VEL, ROT] = dt * skew(GRAVITY)
        flow[:, POS, ROT] = 0.5 * dt * dt * skew(GRAVITY)
        flow[:, POS, VEL] = dt * np.eye(3)
        flow[:, ROT, GYRO] = -dt * self.rot
        flow[:, VEL, ACCEL] = -dt * self.rot
        flow[:, POS, ACCEL] = -0.5 * dt * dt * self.rot
        points = np.concatenate([self.vel[:, None], self.pos[:, None], self.feet], axis=1)
        flow[:, 3:21, GYRO] = (-dt * skew(points) @ self.rot[:, None]).reshape(-1, 18, 3)
        return flow

    def _detect(self, rate: np.ndarray, ankles: np.ndarray, jacobians: np.ndarray, qd: np.ndarray, torque: np.ndarray):
        """Set `contact` from vertical paw forces (torques in static balance), ankle speeds and support."""
        qd, torque = (x.reshape(-1, 4, 3, 1) for x in (qd, torque))
        transposed = np.swapaxes(jacobians, -1, -2)
        # damped least squares: an aligned thigh and shank transmit no force to the motor
        force = -np.linalg.solve(jacobians @ transposed + 1.0e-5 * np.eye(3), jacobians @ torque)[..., 0]
        speed = np.cross(rate[:, None], ankles) + (jacobians @ qd)[..., 0]
        speed = self.vel[:, None] + speed @ np.swapaxes(self.rot, -1, -2)
        up = (force * self.rot[:, None, 2]).sum(-1)
        least = np.where(self.contact, 0.5, 1.0) * self.cfg.force
        speed = np.linalg.norm(speed, axis=-1)
        supported = (self.support > self.cfg.support)[:, None]  # hard stops carry load without motor torque
        self.contact = (speed < self.cfg.speed) & (up > least) | (speed < self.cfg.still) & supported

    def _anchor(self, arms: np.ndarray) -> None:
        """Place the feet that are free, or whose innovation is beyond the gate, at the legs' ankles, uncertain."""
        variance = np.diagonal(self.cov, axis1=-2, axis2=-1)[:, FEET].reshape(-1, 4, 3)
        free = variance[..., 0] > 0.25 * FREE**2
        jump = np.linalg.norm(arms + self.pos[:, None] - self.feet, axis=-1)
        cross = np.stack([self.cov[:, 9 + i, 6 + i % 3] for i in range(12)], axis=-1).reshape(-1, 4, 3)
        spread = variance - 2.0 * cross + np.diagonal(self.cov, axis1=-2, axis2=-1)[:, None, POS]
        far = jump > self.cfg.gate * np.sqrt(spread.max(-1) + self.cfg.leg_noise**2)
        again = ~self.contact | free | far
        self.feet = np.where(again[..., None], self.pos[:, None] + arms, self.feet)
        held = np.ones((len(again), SIZE))
        held[:, FEET] = ~again.repeat(3, axis=-1)
        self.cov = self.cov * held[:, :, None] * held[:, None, :]
        self.cov[:, range(SIZE), range(SIZE)] += (1.0 - held) * FREE**2

    def _correct(self, jacobian: np.ndarray, residual: np.ndarray, noise: np.ndarray) -> None:
        """Apply a Kalman update; jacobian (..., m, 27), residual (n, m), noise (n, m): variances."""
        cross = self.cov @ np.swapaxes(jacobian, -1, -2)
        spread = jacobian @ cross
        spread[:, range(noise.shape[-1]), range(noise.shape[-1])] += noise
        gain = np.swapaxes(np.linalg.solve(spread, np.swapaxes(cross, -1, -2)), -1, -2)
        error = (gain @ residual[..., None])[..., 0]
        cov = self.cov - gain @ np.swapaxes(cross, -1, -2)
        self.cov = 0.5 * (cov + np.swapaxes(cov, -1, -2))
        turn = rotation(error[:, ROT])
        self.rot = turn @ self.rot
        self.vel = (turn @ self.vel[..., None])[..., 0] + error[:, VEL]
        self.pos = (turn @ self.pos[..., None])[..., 0] + error[:, POS]
        self.feet = self.feet @ np.swapaxes(turn, -1, -2) + error[:, FEET].reshape(-1, 4, 3)
        self.gyro_bias = self.gyro_bias + error[:, GYRO]
        self.accel_bias = self.accel_bias + error[:, ACCEL]

    def fix(self, position: np.ndarray, quaternion: np.ndarray | None, time: float) -> None:
        """Correct with a position (3,) [m], world, and orientation (4,) xyzw or None, measured at `time` [s] on `time`.

        The position is compared with the estimate at that time, up to `HISTORY` updates ago; the orientation with the
        present one.
        """
        past = min(self._past, key=lambda entry: abs(entry[0] - time))[1]
        jacobian = np.zeros((len(past), 3, SIZE))
        jacobian[:, :, POS] = np.eye(3)
        jacobian[:, :, ROT] = -skew(past)
        self._correct(jacobian, np.atleast_2d(position) - past, np.full((len(past), 3), self.cfg.fix_position**2))
        if quaternion is None:
            return
        turn = matrix_of(np.atleast_2d(quaternion)) @ np.swapaxes(self.rot, -1, -2)
        q = quaternion_of(turn)
        jacobian = np.zeros((3, SIZE))
        jacobian[:, ROT] = np.eye(3)
        noise = np.full((len(past), 3), self.cfg.fix_rotation**2)
        self._correct(jacobian, 2.0 * np.copysign(1.0, q[:, 3:]) * q[:, :3], noise)

    def estimate(self) -> Estimate:
        """Return the present estimate."""
        sigma = np.sqrt(np.diagonal(self.cov, axis1=-2, axis2=-1))
        bad = ~np.isfinite(self.pos + self.vel).all(-1)
        diverged = bad | ~(sigma[:, VEL].max(-1) < 1.0) | ~(sigma[:, :2].max(-1) < 0.2)
        values = (self.pos, self.vel, quaternion_of(self.rot), self.contact, diverged)
        return Estimate(*(x[0] if self.single else x for x in values))
