"""Contact-aided right-invariant filter: base position, velocity and orientation from IMU, joints and motor torques.

The error is X = exp(xi) X_hat, in the world frame (z up): rotation, velocity, position, gyro and accelerometer bias.
`docs/explanation/estimator.md` derives the equations. All arrays may have a leading dimension of robots. The base
frame's origin is the position, and the IMU's axes and place are the base frame's.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

import numpy as np

from jumper_warp.deploy.kinematics import PAW_RADIUS, legs
from jumper_warp.deploy.sensors import Estimate, unpack_capture

ROT, VEL, POS, GYRO, ACCEL = (slice(3 * i, 3 * i + 3) for i in range(5))
SIZE = 15
GRAVITY = np.array([0.0, 0.0, -9.81])  # [m/s^2]
IDENTITY = np.eye(3)
DIAGONAL = np.eye(4)
CROSS = np.zeros((3, 9))  # cross product with a vector v: (v @ CROSS) as a matrix (3, 3)
CROSS[[0, 0, 1, 1, 2, 2], [7, 5, 2, 6, 3, 1]] = [1.0, -1.0] * 3
FALL = (GRAVITY @ CROSS).reshape(3, 3)  # its cross product
OUTER = np.zeros((9, 4, 4))
"""4 q qᵀ - 1 of the quaternion q (xyzw) of a rotation matrix m: m.reshape(9) @ OUTER.reshape(9, 16)."""
for _i, _j, _k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
    OUTER[4 * _i] = np.diag([1.0 if row in (_i, 3) else -1.0 for row in range(4)])
    OUTER[3 * _j + _k, [_j, _k, _i, 3], [_k, _j, 3, _i]] = [1.0, 1.0, -1.0, -1.0]
    OUTER[3 * _k + _j, [_j, _k, _i, 3], [_k, _j, 3, _i]] = 1.0
MOST_VARIANCE = np.array([0.04, 0.04, np.inf, 1.0, 1.0, 1.0])  # [rad^2], [m^2/s^2] of rotation and velocity
HISTORY = 240  # Updates for which positions are kept for delayed fixes


@dataclass(frozen=True)
class EstimatorCfg:
    """Noise densities, initial standard deviations and thresholds of the filter."""

    gyro_noise: float = 1.0e-3  # [rad/s/√Hz]
    accel_noise: float = 1.0e-2  # [m/s^2/√Hz]
    gyro_walk: float = 1.0e-4  # [rad/s^2/√Hz]
    accel_walk: float = 1.0e-3  # [m/s^3/√Hz]
    paw_noise: float = 0.04  # [m/s] Velocity of a paw at rest, per axis
    paw_scale: float = 0.05  # [1] Error of a paw's velocity relative to the base, as a fraction of it
    slip: float = 0.05  # [m/s] Velocity of a paw at which it has half its weight
    ground: float = 0.01  # [m] Height of the ground below paws in contact; 1000 if unknown, as is `near` then
    near: float = 0.04  # [m] Greatest height of a paw in contact
    start_tilt: float = 0.01  # [rad]
    start_height: float = 0.005  # [m]
    gyro_bias: float = 1.0e-3  # [rad/s] At the start
    accel_bias: float = 0.03  # [m/s^2] At the start
    force: float = 20.0  # [N] Least vertical paw force of a contact
    speed: float = 0.6  # [m/s] Greatest speed of a paw in contact
    still: float = 0.3  # [m/s] Greatest speed of a paw in contact without motor torque, as hard stops carry
    start_place: float = 1.0e-4  # [m], [rad] Horizontal position and yaw; larger with fixes in another frame
    fix_delay: float | None = None  # [s] Age of the captured frames that correct the state; None: unused
    fix_position: float = 0.005  # [m] Noise of external positions


def skew(v: np.ndarray) -> np.ndarray:
    """Return the matrices (..., 3, 3) of the cross products with vectors v (..., 3)."""
    return (v @ CROSS).reshape(*v.shape, 3)


def rotation(vector: np.ndarray) -> np.ndarray:
    """Return the matrices (..., 3, 3) of rotation vectors (..., 3) [rad]."""
    angle = np.sqrt((vector * vector).sum(-1) + 1.0e-24)[..., None, None]
    cross = skew(vector)
    half = np.sin(0.5 * angle) / angle
    return IDENTITY + np.sin(angle) / angle * cross + 2.0 * half * half * (cross @ cross)


def quaternion_of(matrix: np.ndarray) -> np.ndarray:
    """Return the quaternions (..., 4), xyzw, of rotation matrices (..., 3, 3)."""
    outer = (matrix.reshape(-1, 9) @ OUTER.reshape(9, 16)).reshape(-1, 4, 4) + DIAGONAL
    best = outer.diagonal(axis1=-2, axis2=-1).argmax(-1)  # the longest row is the best conditioned
    row = outer[np.arange(len(outer)), best]
    return (row / np.sqrt((row * row).sum(-1, keepdims=True))).reshape(*matrix.shape[:-2], 4)


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

    def reset(self, gyro: np.ndarray, accel: np.ndarray, q: np.ndarray) -> None:
        """Start with a robot at rest on level ground z = 0, above the origin.

        gyro (3,) [rad/s], accel (3,) [m/s^2], q (12,) [rad]: readings at rest, averaged over some 0.1 s. The yaw is 0.
        """
        cfg = self.cfg
        self.single = np.ndim(q) == 1
        gyro, accel, q = (np.atleast_2d(np.asarray(x, dtype=float)) for x in (gyro, accel, q))
        n = len(q)
        self.rot = level(accel)
        self.pos = np.zeros((n, 3))
        self.pos[:, 2] = PAW_RADIUS - (legs(q)[0] @ self.rot[:, 2, :, None]).mean((1, 2))
        self.vel = np.zeros((n, 3))
        self.gyro_bias = gyro.copy()
        self.accel_bias = np.zeros((n, 3))
        self.contact = np.ones((n, 4), dtype=bool)
        tilt, spin, force, place = [cfg.start_tilt] * 2, [cfg.gyro_bias] * 3, [cfg.accel_bias] * 3, cfg.start_place
        sigma = np.array([*tilt, place, *[0.01] * 3, place, place, cfg.start_height, *spin, *force])
        self.cov = np.tile(np.diag(sigma**2), (n, 1, 1))
        self.flow = np.tile(np.eye(SIZE), (n, 1, 1))  # transition matrix of the error
        self.paws = np.zeros((n, 4, SIZE))  # Jacobian of the velocity and height that paws imply
        self.paws[:, range(4), [3, 4, 5, 8]] = 1.0
        self._white = np.repeat([cfg.gyro_noise**2, cfg.accel_noise**2], 3)
        self._walk = np.diag(np.repeat([0.0, 0.0, 0.0, cfg.gyro_walk**2, cfg.accel_walk**2], 3))
        self.time = 0.0
        self._past: deque[tuple[float, np.ndarray]] = deque([(0.0, self.pos)], maxlen=HISTORY)

    def update(
        self, gyro: np.ndarray, accel: np.ndarray, q: np.ndarray, qd: np.ndarray, torque: np.ndarray, dt: float
    ) -> Estimate:
        """Advance by dt [s] and return the estimate.

        gyro (3,) [rad/s] and accel (3,), the specific force [m/s^2], are means over dt; angles q (12,) [rad], rates qd
        (12,) [rad/s] and torques (12,) [N m] are those at its end.
        """
        gyro, accel, q, qd, torque = (np.array(x, dtype=float, ndmin=2) for x in (gyro, accel, q, qd, torque))
        rate = gyro - self.gyro_bias
        self._propagate(rate, accel - self.accel_bias, dt)
        self._observe_paws(rate, q, qd.reshape(-1, 4, 3, 1), torque.reshape(-1, 4, 3, 1))
        self.time += dt
        self._past.append((self.time, self.pos))
        return self.estimate()

    def _propagate(self, rate: np.ndarray, force: np.ndarray, dt: float) -> None:
        """Integrate unbiased rate (n, 3) [rad/s] and specific force (n, 3) [m/s^2] over dt, with the covariance."""
        half = rotation(0.5 * dt * rate)
        middle = self.rot @ half
        acceleration = (middle @ force[..., None])[..., 0] + GRAVITY
        flow = self._flow(dt)
        self.pos = self.pos + dt * self.vel + 0.5 * dt * dt * acceleration
        self.vel = self.vel + dt * acceleration
        self.rot = middle @ half
        self.cov = flow @ self.cov @ flow.swapaxes(-1, -2) + dt * self._walk
        # flow maps a bias error of one into the error of dt seconds of white noise
        inputs = flow[:, :9, 9:]
        self.cov[:, :9, :9] += (inputs * (self._white / dt)) @ inputs.swapaxes(-1, -2)

    def _flow(self, dt: float) -> np.ndarray:
        """Return the transition matrices (n, 15, 15) of the error over dt [s], to second order for the position."""
        flow, step = self.flow, -dt * self.rot
        flow[:, VEL, ROT] = dt * FALL
        flow[:, POS, ROT] = 0.5 * dt * dt * FALL
        flow[:, POS, VEL] = dt * IDENTITY
        flow[:, ROT, GYRO] = flow[:, VEL, ACCEL] = step
        flow[:, POS, ACCEL] = 0.5 * dt * step
        flow[:, VEL, GYRO] = skew(self.vel) @ step
        flow[:, POS, GYRO] = skew(self.pos) @ step
        return flow

    def _observe_paws(self, rate: np.ndarray, q: np.ndarray, qd: np.ndarray, torque: np.ndarray) -> None:
        """Detect contacts, and correct with the base velocity and height that paws at rest on the ground imply.

        rate: (n, 3) unbiased [rad/s]; q: (n, 12) [rad]; qd [rad/s], torque [N m]: (n, 4, 3, 1).
        """
        cfg = self.cfg
        up = self.rot[:, 2]
        ankle, jacobian, turn = legs(q)
        point = ankle - PAW_RADIUS * up[:, None]  # lowest point of each paw, at rest in rolling contact
        jacobian += PAW_RADIUS * skew(up)[:, None] @ turn
        moved = (jacobian @ qd)[..., 0]
        implied = (moved + point @ skew(rate).swapaxes(-1, -2)) @ -self.rot.swapaxes(-1, -2)
        residual = implied - self.vel[:, None]
        height = (point @ up[..., None])[..., 0] + self.pos[:, None, 2]
        # static balance, as damped least squares: an aligned thigh and shank transmit no force to the motor
        normal = jacobian @ jacobian.swapaxes(-1, -2) + 1.0e-5 * IDENTITY
        force = -(up[:, None, None] @ np.linalg.solve(normal, jacobian @ torque))[..., 0, 0]
        square = residual * residual
        speed = np.sqrt(square.sum(-1))
        pushed = (speed < cfg.speed) & (force > np.where(self.contact, 0.5, 1.0) * cfg.force)
        self.contact = (pushed | (speed < cfg.still)) & (height < cfg.near)
        # weighted mean of the paws; slipping ones lose weight
        square[..., :2] = (square[..., 0] + square[..., 1])[..., None]
        noise = cfg.paw_noise**2 + cfg.paw_scale**2 * (moved * moved).sum(-1)[..., None]
        weight = self.contact[..., None] / (noise * (1.0 + square / cfg.slip**2))
        total = weight.sum(1) + 1.0e-9
        count = self.contact.sum(-1, keepdims=True)
        center = (self.contact[:, None] @ point)[:, 0] / np.maximum(count, 1)  # of the paws in contact, body frame
        arm = (self.rot @ center[..., None])[..., 0] + self.pos
        self.paws[:, 3, 0] = arm[:, 1]
        self.paws[:, 3, 1] = -arm[:, 0]
        implied = np.concatenate([(weight * residual).sum(1) / total, -arm[:, 2:]], axis=1)
        noise = np.concatenate([1.0 / total, np.where(count > 0, cfg.ground**2, 1.0e9)], axis=1)
        self._correct(self.paws, implied, noise)

    def _correct(self, jacobian: np.ndarray, residual: np.ndarray, noise: np.ndarray) -> None:
        """Apply a Kalman update; jacobian (..., m, 15), residual (n, m), noise (n, m): variances."""
        cross: np.ndarray = jacobian @ self.cov
        spread = cross @ jacobian.swapaxes(-1, -2)
        spread += noise[..., None] * DIAGONAL[: noise.shape[-1], : noise.shape[-1]]
        gain = np.linalg.solve(spread, cross).swapaxes(-1, -2)
        error = (gain @ residual[..., None])[..., 0]
        cov = self.cov - gain @ cross
        self.cov = 0.5 * (cov + cov.swapaxes(-1, -2))
        turn = rotation(error[:, ROT])
        self.rot = turn @ self.rot
        self.vel = (turn @ self.vel[..., None])[..., 0] + error[:, VEL]
        self.pos = (turn @ self.pos[..., None])[..., 0] + error[:, POS]
        self.gyro_bias = self.gyro_bias + error[:, GYRO]
        self.accel_bias = self.accel_bias + error[:, ACCEL]

    def receive(self, frames: np.ndarray) -> None:
        """Correct with the frames of a motion capture, (3, 8) uint8, if `fix_delay` is set."""
        if self.cfg.fix_delay is not None:
            self.fix(unpack_capture(frames).position, self.time - self.cfg.fix_delay)

    def fix(self, position: np.ndarray, time: float) -> None:
        """Correct with a position (3,) [m], world, measured at `time` [s], up to `HISTORY` updates ago.

        It is compared with the estimate at that time.
        """
        past = min(self._past, key=lambda entry: abs(entry[0] - time))[1]
        jacobian = np.zeros((len(past), 3, SIZE))
        jacobian[:, :, POS] = IDENTITY
        jacobian[:, :, ROT] = -skew(past)
        self._correct(jacobian, np.atleast_2d(position) - past, np.full((len(past), 3), self.cfg.fix_position**2))

    def estimate(self) -> Estimate:
        """Return the present estimate."""
        variance = self.cov.diagonal(axis1=-2, axis2=-1)
        slow, certain = np.abs(self.vel) < 30.0, variance[:, :6] < MOST_VARIANCE
        sure = np.all(slow, axis=-1) & np.all(certain, axis=-1)
        values = (self.pos, self.vel, quaternion_of(self.rot), self.contact, ~sure)
        return Estimate(*(x[0] if self.single else x for x in values))
