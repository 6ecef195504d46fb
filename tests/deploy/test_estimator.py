"""The state estimator against finite differences, ballistic flight and a robot at rest with biased sensors."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from jumper_warp.deploy.estimator import GRAVITY, Estimator, EstimatorCfg, quaternion_of, rotation
from jumper_warp.deploy.kinematics import AXIS_X, FRONT, HIP, PLANE_Y, SHANK, THIGH, legs

DT = 1.0 / 480.0
STANDING = np.tile([0.0, np.pi / 4, np.pi / 4], 4)
UP = -GRAVITY


def static_torque():
    """Return motor torques [N m] (12,) that hold 14.5 kg in the pose STANDING."""
    paw_force = np.array([0.0, 0.0, 14.5 * 9.81 / 4.0])
    return -(np.swapaxes(legs(STANDING)[1], -1, -2) @ paw_force).ravel()


def test_ankle_at_45_degrees_is_as_far_below_the_hips_as_by_hand():
    assert legs(STANDING)[0][:, 2] == pytest.approx(-0.3718, abs=1e-4)


def test_leg_jacobians_are_derivatives_of_ankle_positions():
    q = STANDING + np.random.default_rng(0).normal(0.0, 0.2, (5, 12))
    jacobian = legs(q)[1]
    for motor in range(12):
        step = 1e-6 * np.eye(12)[motor]
        difference = (legs(q + step)[0] - legs(q - step)[0]) / 2e-6
        assert difference[:, motor // 3] == pytest.approx(jacobian[:, motor // 3, :, motor % 3], abs=1e-8)


def test_paws_turn_with_their_inner_shanks():
    q = STANDING + np.random.default_rng(3).normal(0.0, 0.2, 12)

    def knees(q):
        """Return the inner knees in the body frame, with lateral joints at 0."""
        inner = q[2::3]
        return HIP + np.stack([AXIS_X[:, 1] - FRONT * THIGH * np.sin(inner), PLANE_Y, -THIGH * np.cos(inner)], axis=1)

    q[::3] = 0.0
    for motor in (1, 2):
        step = 1e-6 * np.tile(np.eye(3)[motor], 4)
        before, after = (legs(q + sign * step)[0] - knees(q + sign * step) for sign in (-1.0, 1.0))
        turned = np.cross(before, after)[:, 1] / SHANK**2 / 2e-6
        assert turned == pytest.approx(legs(q)[2][:, 1, motor], abs=1e-8)


def test_quaternions_of_matrices_return_the_matrices():
    turns = rotation(np.random.default_rng(1).normal(0.0, 2.0, (50, 3)))
    assert Rotation.from_quat(quaternion_of(turns)).as_matrix() == pytest.approx(turns, abs=1e-12)


def test_flow_is_the_derivative_of_the_propagation():
    random = np.random.default_rng(2)
    gyro, accel = random.normal(0.0, 1.0, (2, 3))

    def end(error):
        """Return rotation, velocity and position after DT, from a state with an error of `flow`'s coordinates."""
        estimator = Estimator()
        estimator.reset(np.zeros(3), UP, STANDING)
        turn = rotation(error[:3])
        estimator.rot = (turn @ rotation(np.array([0.2, -0.1, 0.3])))[None]
        estimator.vel = (turn @ [0.5, -0.3, 1.0] + error[3:6])[None]
        estimator.pos = (turn @ [0.2, 0.1, 0.4] + error[6:9])[None]
        flow = estimator._flow(DT)[0].copy()
        estimator._propagate((gyro - error[9:12])[None], (accel + UP - error[12:15])[None], DT)
        return estimator.rot[0], estimator.vel[0], estimator.pos[0], flow

    rot, vel, pos, flow = end(np.zeros(15))
    for i in range(15):
        size = 1e-5
        other, other_vel, other_pos, _ = end(size * np.eye(15)[i])
        turn = other @ rot.T
        angle = np.array([turn[2, 1], turn[0, 2], turn[1, 0]])
        found = np.concatenate([angle, other_vel - turn @ vel, other_pos - turn @ pos]) / size
        assert found == pytest.approx(flow[:9, i], abs=1e-4)


def test_ballistic_flight_follows_the_parabola():
    estimator = Estimator()
    estimator.reset(np.zeros(3), UP, STANDING)
    start = estimator.pos[0].copy()
    estimator.vel[:] = [0.5, 0.0, 3.0]
    for _ in range(240):
        estimate = estimator.update(np.zeros(3), np.zeros(3), STANDING, np.zeros(12), np.zeros(12), DT)
    assert estimate.velocity == pytest.approx([0.5, 0.0, 3.0 - 9.81 * 0.5], abs=1e-9)
    assert estimate.position == pytest.approx(start + [0.25, 0.0, 1.5 - 0.5 * 9.81 * 0.25], abs=1e-9)
    assert not estimate.contact.any()


def test_a_still_robot_finds_the_biases_that_rest_shows():
    estimator = Estimator(EstimatorCfg(gyro_bias=0.02, accel_bias=0.05))  # the gyro was not still at the start
    gyro = np.array([0.01, -0.01, 0.005])
    accel = UP + [0.0, 0.0, 0.04]
    estimator.reset(np.zeros(3), accel, STANDING)
    for _ in range(960):
        estimate = estimator.update(gyro, accel, STANDING, np.zeros(12), static_torque(), DT)
    assert estimate.contact.all()
    assert estimator.gyro_bias[0, :2] == pytest.approx(gyro[:2], abs=1e-3)
    assert estimator.accel_bias[0, 2] == pytest.approx(0.04, abs=8e-3)
    assert np.abs(estimate.velocity).max() < 1e-3


def test_delayed_fixes_remove_an_error_of_the_position():
    estimator = Estimator(EstimatorCfg(ground=1000.0, near=1000.0))
    estimator.reset(np.zeros(3), UP, STANDING)
    target = estimator.pos[0] + [0.0, 0.0, 0.01]
    for i in range(480):
        estimate = estimator.update(np.zeros(3), UP, STANDING, np.zeros(12), static_torque(), DT)
        if i % 16 == 15:
            estimator.fix(target, estimator.time - 0.02)
    assert estimate.position[2] == pytest.approx(target[2], abs=2e-3)
