"""Forward and inverse kinematics of the legs against Pinocchio and hand calculations.

Motor angles are (12, n): lateral, outer, inner of FL, FR, BL, BR for n robots. Paw positions are (4, n, 3) [m].
"""

import importlib
import math

import numpy as np
import pinocchio as pin
import pytest
import warp as wp
from scipy.spatial.transform import Rotation

from columns import Y, Z
from jumper_warp.robot.description import LEGS, knee_angles, leg_dimensions, load_description
from jumper_warp.robot.model import leg_geometry_array
from jumper_warp.sim.precision import float64_kernels
from support.pinocchio_model import build_pinocchio

LATERAL = (-50.0, 110.0)
TRANSVERSAL = (-30.0, 140.0)
SUM = (0.0, 240.0)
"""[deg] Hard stops of the robot."""
ROBOTS = 200


def make_kernels(package):
    """Return kernels of `kinematics`: motor angles to ankles and, with ankle velocities, rates; ankles to angles."""
    names = ("kinematics.geometry", "kinematics.inverse", "kinematics.leg", "scalar")
    geometry, inverse, leg_kinematics, scalar = (importlib.import_module(f"{package}.{name}") for name in names)
    real, vec3 = scalar.real, scalar.vec3

    @wp.kernel(module="unique", enable_backward=False)
    def forward(
        legs: wp.array(dtype=geometry.LegGeometry), motors: wp.array2d(dtype=real), ankle_vel: wp.array2d(dtype=vec3),
        ankle: wp.array2d(dtype=vec3), rates: wp.array2d(dtype=vec3),
    ):  # fmt: skip
        """Write ankles and rates; launch over (4, n). motors [rad]: (12, n); ankle_vel [m/s]: (4, n)."""
        k, i = wp.tid()
        geo = legs[k]
        angles = vec3(motors[3 * k, i], motors[3 * k + 1, i], motors[3 * k + 2, i])
        ankle[k, i] = leg_kinematics.leg_forward_kinematics(geo, angles[0], angles[1], angles[2])
        rates[k, i] = leg_kinematics.leg_inverse_velocity(geo, angles, ankle_vel[k, i])

    @wp.kernel(module="unique", enable_backward=False)
    def backward(
        legs: wp.array(dtype=geometry.LegGeometry), limits: inverse.LegLimits, ankle: wp.array2d(dtype=vec3),
        motors: wp.array2d(dtype=vec3),
    ):  # fmt: skip
        """Write motor angles; launch over (4, n)."""
        k, i = wp.tid()
        motors[k, i] = inverse.clamped_closed_form(legs[k], limits, ankle[k, i] - legs[k].hip)

    return forward, backward, inverse.LegLimits()


class Build:
    """Kernels of one precision, launched on NumPy arrays; package: jumper_warp.kernels or kernels_float64."""

    def __init__(self, package: str):
        float64_kernels()
        self.scalar = importlib.import_module(f"{package}.scalar")
        self.double = package == "jumper_warp.kernels_float64"
        geometry = importlib.import_module(f"{package}.kinematics.geometry")
        self.legs = leg_geometry_array(load_description(), geometry, "cpu")
        self.forward, self.backward, self.limits = make_kernels(package)
        for name, (lower, upper) in {"lateral": LATERAL, "transversal": TRANSVERSAL, "sum": SUM}.items():
            setattr(self.limits, f"{name}_lower", math.radians(lower))
            setattr(self.limits, f"{name}_upper", math.radians(upper))

    def launch(self, kernel, n, *inputs, outputs):
        """Launch a kernel over (4, n) with NumPy arrays or structs; return its outputs, each (4, n, 3)."""
        dtype = np.float64 if self.double else np.float32
        out = [wp.zeros((4, n), dtype=self.scalar.vec3, device="cpu") for _ in range(outputs)]
        arrays = [
            wp.array(np.asarray(x, dtype), dtype=self.scalar.vec3 if x.ndim == 3 else self.scalar.real, device="cpu")
            if isinstance(x, np.ndarray) else x
            for x in inputs
        ]  # fmt: skip
        wp.launch(kernel, (4, n), [self.legs, *arrays], out, device="cpu")
        return [array.numpy() for array in out]

    def solve(self, ankle):
        """Return the motor angles [rad] (12, n) that bring ankles to positions (4, n, 3) [m] in the body frame."""
        (motors,) = self.launch(self.backward, ankle.shape[1], self.limits, ankle, outputs=1)
        return motors.transpose(0, 2, 1).reshape(12, -1)

    def ankles(self, motors):
        """Return the ankles (4, n, 3) [m] in the body frame at motor angles [rad] (12, n)."""
        return self.launch(self.forward, motors.shape[1], motors, np.zeros((4, motors.shape[1], 3)), outputs=2)[0]

    def rates(self, motors, ankle_vel):
        """Return the motor rates [rad/s] (12, n) for velocities of the ankles [m/s] (4, n, 3) in the body frame."""
        rates = self.launch(self.forward, motors.shape[1], motors, ankle_vel, outputs=2)[1]
        return rates.transpose(0, 2, 1).reshape(12, -1)


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


# --- Position ---


def test_paw_positions_of_default_pose_by_hand(build):
    motors = np.tile(np.radians([0.0, 45.0, 45.0]), 4)[:, None]
    ankle = build.ankles(motors)[:, 0]
    # x: 0.1433 + (0.1417 + 0.0517) / 2; y: hip + 0.05945 + 0.00075; z: five-bar at 45 degrees
    want = [[0.24, 0.1652, -0.3718], [0.24, -0.1652, -0.3718], [-0.24, 0.2102, -0.3718], [-0.24, -0.2102, -0.3718]]
    np.testing.assert_allclose(ankle, want, atol=5.0e-5)


def test_positive_lateral_angle_swings_paws_outward_about_the_hip(build):
    motors = np.tile(np.radians([90.0, 0.0, 0.0]), 4)[:, None]
    ankle = build.ankles(motors)[:, 0]
    # a quarter turn about the hip: out by the leg's 0.4716, and the plane's offset of 0.0602 points up
    assert ankle[:, Y] == pytest.approx([0.105 + 0.4716, -0.105 - 0.4716, 0.15 + 0.4716, -0.15 - 0.4716], abs=5.0e-5)
    assert ankle[:, Z] == pytest.approx(0.0602, abs=5.0e-5)


def test_inverse_kinematics_reaches_the_paws_in_pinocchio(build, robot):
    tolerance = 1.0e-12 if build.double else 5.0e-6  # [m]
    positions, quaternions = random_bases(ROBOTS)
    wanted = random_motors(ROBOTS)
    want = np.array([
        robot.paw_positions(robot.configuration(positions[i], quaternions[i], wanted[:, i])) for i in range(ROBOTS)
    ])  # fmt: skip
    to_body = Rotation.from_quat(quaternions).inv()
    ankle = np.stack([to_body.apply(want[:, leg] - positions) for leg in range(4)])
    motors = build.solve(ankle)
    for i in range(ROBOTS):
        q = robot.configuration(positions[i], quaternions[i], motors[:, i].astype(float))
        np.testing.assert_allclose(robot.paw_positions(q), want[i], atol=tolerance)


def test_every_paw_position_within_limits_is_reached(build):
    paws = build.ankles(random_motors(5000, seed=2))
    np.testing.assert_allclose(build.ankles(build.solve(paws)), paws, atol=1.0e-12 if build.double else 1.0e-6)


def test_inverse_kinematics_inverts_forward_kinematics_with_bent_knees(build):
    # thighs at 10 degrees or more bend both knees
    want = np.radians(np.random.default_rng(3).uniform(10.0, 100.0, (12, 500)))
    np.testing.assert_allclose(build.solve(build.ankles(want)), want, atol=1.0e-11 if build.double else 2.0e-5)


def test_every_pose_is_within_limits(build):
    motors = build.solve(np.random.default_rng(7).uniform(-1.0, 1.0, (4, 500, 3)))
    lateral, outer, inner = np.degrees(motors.astype(np.float64)).reshape(4, 3, 500).swapaxes(0, 1)
    slack = 1.0e-4  # [deg]
    for angle, (low, high) in ((lateral, LATERAL), (outer, TRANSVERSAL), (inner, TRANSVERSAL), (outer + inner, SUM)):
        assert angle.min() > low - slack and angle.max() < high + slack


# --- Velocity ---


def test_inverse_velocity_moves_the_ankle_as_asked():
    double = Build("jumper_warp.kernels_float64")
    rng = np.random.default_rng(8)
    motors = np.radians(rng.uniform(0.0, 110.0, (12, 500)))
    wanted = rng.uniform(-1.0, 1.0, (4, 500, 3))
    step = 1.0e-6 * double.rates(motors, wanted)
    reached = (double.ankles(motors + step) - double.ankles(motors - step)) / 2.0e-6
    np.testing.assert_allclose(reached, wanted, atol=1.0e-6)  # [m/s]


def test_inverse_velocity_of_a_stretched_leg_is_finite_and_damped(build):
    # with the inner thigh at 25 degrees, the outer thigh passes through its shank's line in this sweep
    outer = np.radians(np.linspace(-20.0, 5.0, 2001))
    motors = np.tile([0.0, 0.0, math.radians(25.0)], 4)[:, None] * np.ones((1, 2001))
    motors[1::3] = outer
    legs = [leg_dimensions(load_description(), leg) for leg in LEGS]
    knees = np.array([[knee_angles(leg, angle, math.radians(25.0))[0] for angle in outer] for leg in legs])
    assert knees.min() < -0.05 and knees.max() > 0.05
    rates = build.rates(motors, np.tile([0.0, 0.0, -1.0], (4, 2001, 1)))
    # at most 1 m/s over the 10 mm of lever at which damping sets in, and nothing in the straight pose itself
    assert np.isfinite(rates).all() and np.abs(rates).max() < 101.0
    straight = np.abs(knees).argmin(axis=1)
    assert (np.abs(rates[1::3][np.arange(4), straight]) < 5.0).all()


def test_rates_that_cancel_the_base_twist_hold_the_ankles_still_in_pinocchio(build, robot):
    """The base moves and turns at random; motor rates for the opposite ankle velocity keep the paws still."""
    tolerance = 1.0e-9 if build.double else 5.0e-5  # [m/s]
    rng = np.random.default_rng(9)
    n = 50
    base_pos, base_quat = random_bases(n)
    lin, ang = rng.uniform(-1.0, 1.0, (2, n, 3))
    motors = np.radians(rng.uniform(10.0, 100.0, (12, n)))
    to_body = Rotation.from_quat(base_quat).inv()
    twist = np.concatenate([to_body.apply(lin), to_body.apply(ang)], axis=1)
    rates = build.rates(motors, -(twist[:, :3] + np.cross(twist[:, 3:], build.ankles(motors))))
    for i in range(n):
        q = robot.configuration(base_pos[i], base_quat[i], motors[:, i])
        v = robot.closed_velocity(q, twist[i], rates[:, i])
        pin.forwardKinematics(robot.model, robot.data, q, v)
        for c in robot.constraints:
            for joint, placement in ((c.joint1_id, c.joint1_placement), (c.joint2_id, c.joint2_placement)):
                end = placement.actInv(robot.data.v[joint]).linear
                np.testing.assert_allclose(end, 0.0, atol=tolerance)
