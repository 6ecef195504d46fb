"""Inverse kinematics against Pinocchio, and hand calculations.

Motor angles are (12, n): lateral, outer, inner of FL, FR, BL, BR for n robots. Paw positions are (4, n, 3) [m].
"""

import importlib
import math
from typing import NamedTuple

import numpy as np
import pinocchio as pin
import pytest
import warp as wp
from scipy.spatial.transform import Rotation

from jumper_warp.robot.description import load_description
from jumper_warp.robot.model import leg_geometry_array
from jumper_warp.sim.precision import float64_kernels
from leg_kernels import make_inverse_kernel, make_leg_kernel
from pinocchio_model import build_pinocchio

LATERAL = (-50.0, 110.0)
TRANSVERSAL = (-30.0, 140.0)
SUM = (0.0, 240.0)
"""[deg] Hard stops of the robot."""
ROBOTS = 200


class Legs(NamedTuple):
    """Legs of n robots, each (4, n, ...), in the body frame."""

    ankle: np.ndarray  # (4, n, 3) [m]
    knees: np.ndarray  # (4, n, 2) [rad] outer, inner
    rates: np.ndarray  # (4, n, 3) [rad/s] motor rates that move the ankle by the given velocity
    knee_rates: np.ndarray  # (4, n, 2) [rad/s]


class Build:
    """Kernels of one precision, launched on NumPy arrays; package: jumper_warp.kernels or kernels_float64."""

    def __init__(self, package: str):
        float64_kernels()
        self.scalar = importlib.import_module(f"{package}.scalar")
        self.double = package == "jumper_warp.kernels_float64"
        geometry = importlib.import_module(f"{package}.kinematics.geometry")
        self.legs = leg_geometry_array(load_description(), geometry, "cpu")
        self.leg_kernel, self.inverse_kernel = make_leg_kernel(package), make_inverse_kernel(package)
        self.limits = importlib.import_module(f"{package}.kinematics.inverse").LegLimits()
        for name, (lower, upper) in {"lateral": LATERAL, "transversal": TRANSVERSAL, "sum": SUM}.items():
            setattr(self.limits, f"{name}_lower", math.radians(lower))
            setattr(self.limits, f"{name}_upper", math.radians(upper))

    def array(self, values, dtype):
        """Return values as a Warp array of this precision; dtype: a Warp scalar or vector type."""
        return wp.array(np.asarray(values, np.float64 if self.double else np.float32), dtype=dtype, device="cpu")

    def zeros(self, rows, n, dtype=None):
        """Return a Warp array of zeros, (rows, n), by default of scalars of this precision."""
        return wp.zeros((rows, n), dtype=dtype or self.scalar.real, device="cpu")

    def solve(self, paws):
        """Return motor angles [rad], (12, n), for paws [m], (4, n, 3), in the body frame."""
        motors = self.zeros(12, paws.shape[1])
        inputs = [self.legs, self.limits, self.array(paws, self.scalar.vec3)]
        wp.launch(self.inverse_kernel, (4, paws.shape[1]), inputs, [motors], device="cpu")
        return motors.numpy()

    def legs_at(self, motors, ankle_vel=None):
        """Return the `Legs` at motor angles.

        motors [rad]: (12, n); ankle_vel [m/s]: (4, n, 3), None: zero; all in the body frame.
        """
        n, s = motors.shape[1], self.scalar
        inputs = [self.legs, self.array(motors, s.real)]
        inputs.append(self.array(np.zeros((4, n, 3)) if ankle_vel is None else ankle_vel, s.vec3))
        out = [self.zeros(4, n, dtype) for dtype in (s.vec3, s.vec2, s.vec3, s.vec2)]
        wp.launch(self.leg_kernel, (4, n), inputs, out, device="cpu")
        return Legs(*(array.numpy() for array in out))


@pytest.fixture(scope="module", params=["jumper_warp.kernels", "jumper_warp.kernels_float64"])
def build(request):
    """Return the `Build` of each precision."""
    return Build(request.param)


@pytest.fixture(scope="module")
def robot():
    """Return Pinocchio's model of the robot, the oracle."""
    return build_pinocchio()


def random_motors(n, seed=0):
    """Return random motor angles [rad] within the hard stops, (12, n)."""
    rng = np.random.default_rng(seed)
    thighs = rng.uniform(*TRANSVERSAL, (16 * n, 2))
    thighs = thighs[(thighs.sum(1) >= SUM[0]) & (thighs.sum(1) <= SUM[1])][: 4 * n].reshape(4, n, 2)
    motors = np.concatenate([rng.uniform(*LATERAL, (4, n, 1)), thighs], axis=2)
    return np.radians(motors.transpose(0, 2, 1).reshape(12, n))


def random_bases(n, seed=1):
    """Return random base positions [m] (n, 3) and quaternions xyzw (n, 4)."""
    rng = np.random.default_rng(seed)
    return rng.uniform(-1.0, 1.0, (n, 3)), Rotation.random(n, random_state=seed).as_quat()


def reached_by_pinocchio(robot, q):
    """Return the ankle ends of inner and outer shanks in the world, (2, 4, 3) [m]; q: Pinocchio's configuration."""
    pin.forwardKinematics(robot.model, robot.data, q)
    ends = [
        [robot.data.oMi[c.joint1_id].act(c.joint1_placement).translation for c in robot.constraints],
        [robot.data.oMi[c.joint2_id].act(c.joint2_placement).translation for c in robot.constraints],
    ]
    return np.array(ends)


# --- Forward: hand calculations and derivatives ---


def test_paw_positions_of_default_pose_by_hand(build):
    motors = np.tile(np.radians([0.0, 45.0, 45.0]), 4)[:, None]
    ankle = build.legs_at(motors).ankle[:, 0]
    # x: 0.1433 + (0.1417 + 0.0517) / 2; y: hip + 0.05945 + 0.00075; z: five-bar at 45 degrees
    want = [[0.24, 0.1652, -0.3718], [0.24, -0.1652, -0.3718], [-0.24, 0.2102, -0.3718], [-0.24, -0.2102, -0.3718]]
    np.testing.assert_allclose(ankle, want, atol=5.0e-5)


# --- Position: reachable targets ---


def test_inverse_kinematics_closes_the_loop_in_pinocchio(build, robot):
    tolerance = 1.0e-12 if build.double else 5.0e-6  # [m]
    pose = robot.configuration(np.zeros(3), np.array([0.0, 0.0, 0.0, 1.0]), random_motors(1)[:, 0])
    want = np.empty((4, ROBOTS, 3))
    for i, motors in enumerate(random_motors(ROBOTS).T):
        want[:, i] = reached_by_pinocchio(robot, robot.configuration(pose[:3], pose[3:7], motors))[0]
    motors = build.solve(want)
    knees = build.legs_at(motors).knees.transpose(0, 2, 1).reshape(8, ROBOTS)
    for i in range(ROBOTS):
        q = pose.copy()
        q[robot.motor_q] = motors[:, i]
        q[robot.knee_q] = knees[:, i]
        inner_ends, outer_ends = reached_by_pinocchio(robot, q)
        np.testing.assert_allclose(inner_ends, want[:, i], atol=tolerance)
        np.testing.assert_allclose(outer_ends, want[:, i], atol=tolerance)


def test_every_paw_position_within_limits_is_reached(build):
    paws = build.legs_at(random_motors(5000, seed=2)).ankle
    motors = build.solve(paws)
    np.testing.assert_allclose(build.legs_at(motors).ankle, paws, atol=1.0e-12 if build.double else 1.0e-6)


def test_inverse_kinematics_inverts_forward_kinematics_with_bent_knees(build):
    # thighs at 10 degrees or more bend both knees
    rng = np.random.default_rng(3)
    want = np.radians(rng.uniform(10.0, 100.0, (12, 500)))
    motors = build.solve(build.legs_at(want).ankle)
    np.testing.assert_allclose(motors, want, atol=1.0e-11 if build.double else 2.0e-5)
    assert (build.legs_at(motors).knees > 0.0).all()


def test_every_pose_is_within_limits(build):
    targets = np.random.default_rng(7).uniform(-1.0, 1.0, (4, 500, 3))
    lateral, outer, inner = np.degrees(build.solve(targets).astype(np.float64)).reshape(4, 3, 500).swapaxes(0, 1)
    slack = 1.0e-4  # [deg]
    for angle, (low, high) in ((lateral, LATERAL), (outer, TRANSVERSAL), (inner, TRANSVERSAL), (outer + inner, SUM)):
        assert angle.min() > low - slack and angle.max() < high + slack


# --- Velocity ---


def test_inverse_velocity_of_a_stretched_leg_is_finite_and_damped(build):
    # with the inner thigh at 25 degrees, the outer thigh passes through its shank's line in this sweep
    outer = np.radians(np.linspace(-20.0, 5.0, 2001))
    motors = np.tile([0.0, 0.0, math.radians(25.0)], 4)[:, None] * np.ones((1, 2001))
    motors[1::3] = outer
    knees = build.legs_at(motors).knees[:, :, 0]  # outer
    assert knees.min() < -0.05 and knees.max() > 0.05
    rates = build.legs_at(motors, np.tile([0.0, 0.0, -1.0], (4, 2001, 1))).rates
    # at most 1 m/s over the 10 mm of lever at which damping sets in, and nothing in the straight pose itself
    assert np.isfinite(rates).all() and np.abs(rates).max() < 101.0
    straight = np.abs(knees).argmin(axis=1)
    assert (np.abs(rates[np.arange(4), straight, 1]) < 5.0).all()


def test_rates_that_cancel_the_base_twist_hold_the_ankles_still_in_pinocchio(build, robot):
    """The base moves and turns at random; motor and knee rates for the opposite ankle velocity keep both ends still."""
    tolerance = 1.0e-9 if build.double else 5.0e-5  # [m/s]
    rng = np.random.default_rng(9)
    n = 50
    base_pos, base_quat = random_bases(n)
    lin, ang = rng.uniform(-1.0, 1.0, (2, n, 3))
    motors = np.radians(rng.uniform(10.0, 100.0, (12, n)))
    to_body = Rotation.from_quat(base_quat).inv()
    rigid_velocity = to_body.apply(lin) + np.cross(to_body.apply(ang), build.legs_at(motors).ankle)  # [m/s], body axes
    _, _, rates, knee_rates = build.legs_at(motors, -rigid_velocity)
    for i in range(n):
        q = robot.configuration(base_pos[i], base_quat[i], motors[:, i])
        v = np.zeros(robot.model.nv)
        v[:6] = np.concatenate([to_body[i].apply(lin[i]), to_body[i].apply(ang[i])])
        v[robot.motor_v] = rates[:, i].ravel()
        v[robot.knee_v] = knee_rates[:, i].ravel()
        pin.forwardKinematics(robot.model, robot.data, q, v)
        for c in robot.constraints:
            for joint, placement in ((c.joint1_id, c.joint1_placement), (c.joint2_id, c.joint2_placement)):
                end = placement.actInv(robot.data.v[joint]).linear
                np.testing.assert_allclose(end, 0.0, atol=tolerance)
