"""Inverse kinematics against Pinocchio, a sampled search for the nearest reachable point, and hand calculations.

Motor angles are (12, n): lateral, outer, inner of FL, FR, BL, BR for n robots. Paw positions are (4, n, 3) [m].
"""

import functools
import importlib
import math
from typing import NamedTuple

import numpy as np
import pinocchio as pin
import pytest
import warp as wp
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from columns import Y, Z
from jumper_warp.robot.description import load_description
from jumper_warp.robot.model import leg_geometry, leg_geometry_array
from jumper_warp.sim.precision import float64_kernels
from support.pinocchio_model import build_pinocchio

LATERAL = (-50.0, 110.0)
TRANSVERSAL = (-30.0, 140.0)
SUM = (0.0, 240.0)
"""[deg] Hard stops of the robot."""
ROBOTS = 200


class Legs(NamedTuple):
    """Legs of n robots, each (4, n, ...), in the body frame."""

    ankle: np.ndarray  # (4, n, 3) [m]
    jacobian: np.ndarray  # (4, n, 3, 3) [m/rad] of the ankle by lateral, outer, inner
    knees: np.ndarray  # (4, n, 2) [rad] outer, inner
    rates: np.ndarray  # (4, n, 3) [rad/s] motor rates that move the ankle by the given velocity
    knee_rates: np.ndarray  # (4, n, 2) [rad/s]


def make_leg_kernel(package):
    """Return a kernel that evaluates the functions of `kinematics.leg` at joint angles and ankle velocities."""
    names = ("kinematics.five_bar", "kinematics.geometry", "scalar", "kinematics.leg")
    five_bar, geometry, scalar, leg_kinematics = (importlib.import_module(f"{package}.{name}") for name in names)
    real, vec2, vec3 = scalar.real, scalar.vec2, scalar.vec3

    @wp.kernel(module="unique", enable_backward=False)
    def leg_kernel(
        legs: wp.array(dtype=geometry.LegGeometry), motors: wp.array2d(dtype=real), ankle_vel: wp.array2d(dtype=vec3),
        ankle: wp.array2d(dtype=vec3), jacobian: wp.array2d(dtype=scalar.mat33), knees: wp.array2d(dtype=vec2),
        motor_rates: wp.array2d(dtype=vec3), knee_rates: wp.array2d(dtype=vec2),
    ):  # fmt: skip
        """Write the outputs of `Build.legs_at`; launch over (4, n). motors [rad]: (12, n); ankle_vel [m/s]: (4, n)."""
        k, i = wp.tid()
        geo = legs[k]
        angles = vec3(motors[3 * k, i], motors[3 * k + 1, i], motors[3 * k + 2, i])
        ankle[k, i] = leg_kinematics.leg_forward_kinematics(geo, angles[0], angles[1], angles[2])
        jacobian[k, i] = leg_kinematics.leg_jacobian(geo, angles[0], angles[1], angles[2])
        loop = five_bar.five_bar(geo, angles[1], angles[2])
        knees[k, i] = leg_kinematics.knee_angles(geo, loop, angles[1], angles[2])
        rates = leg_kinematics.leg_inverse_velocity(geo, angles, ankle_vel[k, i])
        motor_rates[k, i] = rates
        outer_shank_rate = loop.outer_shank_do * rates[1] + loop.outer_shank_di * rates[2]
        inner_shank_rate = loop.inner_shank_do * rates[1] + loop.inner_shank_di * rates[2]
        knee_rates[k, i] = vec2(rates[1] + geo.front * outer_shank_rate, rates[2] - geo.front * inner_shank_rate)

    return leg_kernel


class Build:
    """Kernels of one precision, launched on NumPy arrays; package: jumper_warp.kernels or kernels_float64."""

    def __init__(self, package: str):
        float64_kernels()
        self.ik = importlib.import_module(f"{package}.kinematics.inverse")
        self.scalar = importlib.import_module(f"{package}.scalar")
        self.double = package == "jumper_warp.kernels_float64"
        geometry = importlib.import_module(f"{package}.kinematics.geometry")
        self.legs = leg_geometry_array(load_description(), geometry, "cpu")
        self.leg_kernel = make_leg_kernel(package)
        self.limits = self.ik.LegLimits()
        for name, (lower, upper) in {"lateral": LATERAL, "transversal": TRANSVERSAL, "sum": SUM}.items():
            setattr(self.limits, f"{name}_lower", math.radians(lower))
            setattr(self.limits, f"{name}_upper", math.radians(upper))

    def array(self, values, dtype):
        """Return values as a Warp array of this precision; dtype: a Warp scalar or vector type."""
        return wp.array(np.asarray(values, np.float64 if self.double else np.float32), dtype=dtype, device="cpu")

    def zeros(self, rows, n, dtype=None):
        """Return a Warp array of zeros, (rows, n), by default of scalars of this precision."""
        return wp.zeros((rows, n), dtype=dtype or self.scalar.real, device="cpu")

    def solve(self, paws, base_pos=None, base_quat=None):
        """Return motors (12, n), knees (8, n) [rad], reachable (4, n), residual [m] (4, n) for paws (4, n, 3) [m].

        Paws are in the world frame if base_pos [m] (n, 3) and base_quat (n, 4) are passed, else in the body frame.
        """
        n, vec3, quat = paws.shape[1], self.scalar.vec3, self.scalar.quat
        in_world = base_pos is not None
        pos = self.array(base_pos if in_world else np.zeros((n, 3)), vec3)
        orientation = self.array(base_quat if in_world else np.zeros((n, 4)), quat)
        out = [self.zeros(12, n), self.zeros(8, n), self.zeros(4, n, wp.int32), self.zeros(4, n)]
        inputs = [self.legs, self.limits, pos, orientation, self.array(paws, vec3), int(in_world)]
        wp.launch(self.ik.inverse_kinematics_kernel, (4, n), inputs, out, device="cpu")
        return [array.numpy() for array in out]

    def legs_at(self, motors, ankle_vel=None):
        """Return the `Legs` at motor angles.

        motors [rad]: (12, n); ankle_vel [m/s]: (4, n, 3), None: zero; all in the body frame.
        """
        n, s = motors.shape[1], self.scalar
        inputs = [self.legs, self.array(motors, s.real)]
        inputs.append(self.array(np.zeros((4, n, 3)) if ankle_vel is None else ankle_vel, s.vec3))
        out = [self.zeros(4, n, dtype) for dtype in (s.vec3, s.mat33, s.vec2, s.vec3, s.vec2)]
        wp.launch(self.leg_kernel, (4, n), inputs, out, device="cpu")
        return Legs(*(array.numpy() for array in out))


@pytest.fixture(scope="module", params=["jumper_warp.kernels", "jumper_warp.kernels_float64"])
def build(request):
    """Return the `Build` of each precision."""
    return Build(request.param)


@pytest.fixture(scope="module")
def double():
    """Return the `Build` of double precision."""
    return Build("jumper_warp.kernels_float64")


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


def test_positive_lateral_angle_swings_paws_outward_about_the_hip(build):
    motors = np.tile(np.radians([90.0, 0.0, 0.0]), 4)[:, None]
    ankle = build.legs_at(motors).ankle[:, 0]
    # a quarter turn about the hip: out by the leg's 0.4716, and the plane's offset of 0.0602 points up
    assert ankle[:, Y] == pytest.approx([0.105 + 0.4716, -0.105 - 0.4716, 0.15 + 0.4716, -0.15 - 0.4716], abs=5.0e-5)
    assert ankle[:, Z] == pytest.approx(0.0602, abs=5.0e-5)


def test_jacobian_matches_central_differences(double):
    motors, size = random_motors(ROBOTS), 1.0e-5  # [rad]
    jacobian = double.legs_at(motors).jacobian
    for joint in range(3):
        step = np.zeros((12, 1))
        step[joint::3] = size
        difference = (double.legs_at(motors + step).ankle - double.legs_at(motors - step).ankle) / (2.0 * size)
        np.testing.assert_allclose(jacobian[:, :, :, joint], difference, atol=2.0e-8)  # [m/rad]


# --- Position: reachable targets ---


def test_inverse_kinematics_closes_the_loop_in_pinocchio(build, robot):
    tolerance = 1.0e-12 if build.double else 5.0e-6  # [m]
    base_pos, base_quat = random_bases(ROBOTS)
    want = np.empty((4, ROBOTS, 3))
    for i, motors in enumerate(random_motors(ROBOTS).T):
        want[:, i] = reached_by_pinocchio(robot, robot.configuration(base_pos[i], base_quat[i], motors))[0]
    motors, knees, reachable, residual = build.solve(want, base_pos, base_quat)
    assert reachable.all()
    assert residual.max() < tolerance
    for i in range(ROBOTS):
        q = robot.configuration(base_pos[i], base_quat[i], random_motors(1)[:, 0])
        q[robot.motor_q] = motors[:, i]
        q[robot.knee_q] = knees[:, i]
        inner_ends, outer_ends = reached_by_pinocchio(robot, q)
        np.testing.assert_allclose(inner_ends, want[:, i], atol=tolerance)
        np.testing.assert_allclose(outer_ends, want[:, i], atol=tolerance)


def test_every_paw_position_within_limits_is_reached(build):
    paws = build.legs_at(random_motors(5000, seed=2)).ankle
    motors, _, reachable, residual = build.solve(paws)
    assert reachable.all()
    assert residual.max() < (1.0e-12 if build.double else 1.0e-6)
    np.testing.assert_allclose(build.legs_at(motors).ankle, paws, atol=1.0e-12 if build.double else 1.0e-6)


def test_inverse_kinematics_inverts_forward_kinematics_with_bent_knees(build):
    # thighs at 10 degrees or more bend both knees
    rng = np.random.default_rng(3)
    want = np.radians(rng.uniform(10.0, 100.0, (12, 500)))
    motors, knees, _, _ = build.solve(build.legs_at(want).ankle)
    np.testing.assert_allclose(motors, want, atol=1.0e-11 if build.double else 2.0e-5)
    assert (knees > 0.0).all()


# --- Position: targets out of reach ---


def sampled_ankle(geo, q):
    """Return ankles [m] in the body frame, (..., 3), for q (..., 3): lateral, outer, inner [rad]."""
    lateral, outer, inner = np.moveaxis(q, -1, 0)
    front, thigh = geo["front"], geo["thigh"]
    outer_knee = geo["outer_x"] + front * thigh * np.sin(outer) - 1j * thigh * np.cos(outer)
    inner_knee = geo["inner_x"] - front * thigh * np.sin(inner) - 1j * thigh * np.cos(inner)
    span = outer_knee - inner_knee
    down = -1j * front * span / np.abs(span)
    ankle = 0.5 * (outer_knee + inner_knee) + down * np.sqrt(geo["shank"] ** 2 - 0.25 * np.abs(span) ** 2)
    across = (geo["plane_y"] + geo["knee_y"] + 1j * ankle.imag) * np.exp(1j * geo["side"] * lateral)
    return np.array(geo["hip"]) + np.stack([ankle.real, across.real, across.imag], axis=-1)


def into_limits(q):
    """Return joint angles [rad] (..., 3) clipped to the hard stops; an excess of the sum is halved between its two."""
    lower, upper = np.radians([LATERAL, TRANSVERSAL, TRANSVERSAL]).T
    clamped = np.clip(q, lower, upper)
    total = clamped[..., 1] + clamped[..., 2]  # outer + inner
    clamped[..., 1:] += 0.5 * (np.clip(total, *np.radians(SUM)) - total)[..., None]
    return clamped


@functools.cache
def nearest_by_sampling(leg):
    """Return 120 targets (n, 3) around a leg's hip and their distances to the reachable set (n,), both [m].

    The search samples finer and finer grids around the 20 best points.
    """
    geo = leg_geometry(load_description())[leg]
    targets = np.array(geo["hip"]) + np.random.default_rng(leg).uniform(-0.7, 0.7, (120, 3))
    axes = [np.radians(np.linspace(*limits, n)) for limits, n in ((LATERAL, 41), (TRANSVERSAL, 52), (TRANSVERSAL, 52))]
    grid = into_limits(np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3))
    centers = grid[cKDTree(sampled_ankle(geo, grid)).query(targets, 20)[1]]
    offsets = np.stack(np.meshgrid(*[np.linspace(-1.0, 1.0, 7)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    for width in np.radians(5.0) * 0.5 ** np.arange(7):
        around = into_limits(centers[:, :, None] + width * offsets)
        miss = np.linalg.norm(sampled_ankle(geo, around) - targets[:, None, None], axis=-1)
        best = miss.argmin(axis=-1)
        centers = np.take_along_axis(around, best[..., None, None], axis=2)[:, :, 0]
    return targets, miss.min(axis=(1, 2))


@pytest.mark.parametrize("leg", [0, 3], ids=["FL", "BR"])
def test_nearest_reachable_point_is_within_2_mm_of_a_sampled_search(build, leg):
    geo = leg_geometry(load_description())[leg]
    targets, nearest = nearest_by_sampling(leg)
    motors, _, reachable, residual = build.solve(np.tile(targets, (4, 1, 1)))
    assert 0 < reachable[leg].sum() < 60  # of 120: most targets are out of reach
    assert (residual[leg] - nearest).max() < 2.0e-3  # [m]
    assert (residual[leg] - nearest).min() > -3.0e-4  # the sampled search stops near 0.2 mm
    ankle = sampled_ankle(geo, motors[3 * leg : 3 * leg + 3].T.astype(np.float64))
    np.testing.assert_allclose(np.linalg.norm(ankle - targets, axis=1), residual[leg], atol=2.0e-6)


def test_reachable_flag_is_set_where_the_residual_is_below_10_micrometres(build):
    paws = build.legs_at(random_motors(1000, seed=6)).ankle
    far_paws = paws + np.array([0.0, 0.0, -1.0])
    for targets in (paws, far_paws):
        _, _, reachable, residual = build.solve(targets)
        np.testing.assert_array_equal(reachable == 1, residual < 1.0e-5)


def test_target_below_reach_gives_stretched_leg(build):
    # 0.1 m below the deepest point, 0.4716 below the axes in a plane 0.0602 outward of the hip
    geo = leg_geometry(load_description())[0]
    below = np.array(geo["hip"]) + [0.0967, 0.0602, -0.5716]
    motors, _, reachable, residual = build.solve(np.tile(below, (4, 1, 1)))
    assert reachable[0, 0] == 0
    assert motors[1:3, 0] == pytest.approx([0.0, 0.0], abs=1.0e-3)
    assert residual[0, 0] == pytest.approx(math.hypot(0.5716, 0.0602) - math.hypot(0.4716, 0.0602), abs=2.0e-5)


def test_every_pose_is_within_limits(build):
    targets = np.random.default_rng(7).uniform(-1.0, 1.0, (4, 500, 3))
    motors, _, _, _ = build.solve(targets)
    lateral, outer, inner = np.degrees(motors.astype(np.float64)).reshape(4, 3, 500).swapaxes(0, 1)
    slack = 1.0e-4  # [deg]
    for angle, (low, high) in ((lateral, LATERAL), (outer, TRANSVERSAL), (inner, TRANSVERSAL), (outer + inner, SUM)):
        assert angle.min() > low - slack and angle.max() < high + slack


@pytest.mark.parametrize("depth", [1.0e3, 1.0e12, 1.0e30])  # [m]
def test_target_far_below_stretches_the_legs_under_the_hips(build, depth):
    motors, _, reachable, _ = build.solve(np.tile([0.0, 0.0, -depth], (4, 1, 1)))
    assert not reachable.any()
    # the ankle, 0.4716 below and 0.0602 outward of the hip, swings below the hip by atan of their ratio
    np.testing.assert_allclose(motors[0::3], -math.atan2(0.0602, 0.4716), atol=math.radians(2.0))
    np.testing.assert_allclose(motors[1::3], 0.0, atol=math.radians(2.0))
    np.testing.assert_allclose(motors[2::3], 0.0, atol=math.radians(2.0))


def test_non_finite_target_puts_the_ankle_0_3_below_the_axes(build):
    motors = build.solve(np.full((4, 1, 3), math.nan))[0]
    ankle = build.legs_at(motors).ankle[:, 0]
    want = [[0.24, 0.1652, -0.3], [0.24, -0.1652, -0.3], [-0.24, 0.2102, -0.3], [-0.24, -0.2102, -0.3]]
    np.testing.assert_allclose(ankle, want, atol=1.0e-6)


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf, 1.0e30, -1.0e30, 0.0])
@pytest.mark.parametrize("axes", [[0], [1], [2], [0, 1, 2]])
def test_non_finite_huge_and_central_targets_give_finite_unreachable_poses(build, value, axes):
    targets = np.array([leg["hip"] for leg in leg_geometry(load_description())])[:, None]
    targets[:, :, axes] = value  # value 0: the centre of the body and points level with the hips
    motors, knees, reachable, residual = build.solve(targets)
    assert np.isfinite(motors).all() and np.isfinite(knees).all()
    assert not reachable.any()
    assert not np.isnan(residual).any() and (residual > 0.05).all()  # [m]


def test_non_finite_base_gives_finite_unreachable_poses(build):
    motors, knees, reachable, _ = build.solve(np.zeros((4, 1, 3)), np.full((1, 3), math.nan), [[0.0, 0.0, 0.0, 1.0]])
    assert np.isfinite(motors).all() and np.isfinite(knees).all()
    assert not reachable.any()


# --- Velocity ---


def test_inverse_velocity_undoes_the_jacobian(build):
    rng = np.random.default_rng(8)
    motors = np.radians(rng.uniform(-5.0, 110.0, (12, 500)))
    motors[1::3] = np.abs(motors[1::3])
    motors[2::3] = np.abs(motors[2::3])
    wanted = rng.uniform(-1.0, 1.0, (4, 500, 3))
    legs = build.legs_at(motors, wanted)
    reached = np.einsum("lnij,lnj->lni", legs.jacobian, legs.rates)
    np.testing.assert_allclose(reached, wanted, atol=1.0e-12 if build.double else 2.0e-5)  # [m/s]


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
    _, _, _, rates, knee_rates = build.legs_at(motors, -rigid_velocity)
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
