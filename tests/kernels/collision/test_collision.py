import importlib
from functools import cache

import numpy as np
import pytest
import warp as wp
from scipy.spatial.transform import Rotation

from coal_shapes import box, capsule, coal_distance
from collision_kernels import make_collision_kernel
from columns import POS, QUAT, Z
from jumper_warp.kernels.collision import robot as collision_module
from jumper_warp.kernels.kinematics import geometry as geometry_module
from jumper_warp.kernels.kinematics.geometry import LegGeometry
from jumper_warp.kernels.scalar import quat, vec3
from jumper_warp.kernels.terrain import ground
from jumper_warp.kernels.terrain.ground import Ground
from jumper_warp.robot.description import load_description
from jumper_warp.robot.model import leg_geometry_array
from jumper_warp.sim.precision import float64_kernels

wp.set_module_options({"enable_backward": False})

LEGS = ((1, 1), (1, -1), (-1, 1), (-1, -1))  # FL, FR, BL, BR as (front, side)
NEIGHBOURS = ((0, 1), (2, 3), (0, 2), (1, 3))  # pairs of legs that can touch
FLAGS = "BODY_GROUND HOUSING_GROUND THIGH_GROUND KNEE_GROUND SHANK_GROUND LEG_LEG LEG_SELF LEG_SHELL".split()
MASKS = np.array([getattr(collision_module, name) for name in FLAGS])
THIGH, SHANK, PAW, HOUSING = 0.019, 0.012, 0.025, 0.048  # radii [m]
# shell boxes [m]: smallest and largest corner
NOSE = ((-0.343, -0.05, -0.049), (0.343, 0.05, 0.099))
TRUNK = ((-0.144, -0.112, -0.049), (0.144, 0.112, 0.099))
FRONT_DRUMS = ((0.081, -0.154, -0.049), (0.144, 0.154, 0.049))
REAR_DRUMS = ((-0.144, -0.199, -0.049), (-0.080, 0.199, 0.049))


def leg_array(module=geometry_module):
    """Return the robot's four `LegGeometry` of `module` (single or double precision) as a Warp array."""
    return leg_geometry_array(load_description(), module, "cpu")


def make_ground(module=ground, heights=None):
    """Return a plane z = 0, or a grid of heights [m] (rows along y, columns along x) over x and y within ±2 m."""
    result = module.Ground()
    result.rows, result.cols = (0, 0) if heights is None else heights.shape
    result.half_x = result.half_y = 2.0
    result.heights = wp.array(np.zeros((1, 1)) if heights is None else heights, dtype=wp.float32, device="cpu")
    return result


def joint_coordinates(pos, quat_xyzw, motors):
    """Return Newton's joint_q, (n, 43), for motor angles [rad] (n, 12); knees and loop joints, not read, are NaN."""
    motors = np.atleast_2d(motors)
    joint_q = np.full((len(motors), 43), np.nan, np.float32)
    joint_q[:, POS], joint_q[:, QUAT] = pos, quat_xyzw
    for leg in range(4):
        joint_q[:, 7 + 5 * leg + np.array([0, 1, 3])] = motors[:, 3 * leg : 3 * leg + 3]
    return joint_q


def collide(pos, quat_xyzw, motors_deg, margin=1.0, heights=None, module=collision_module):
    """Return flags and clearance [m], each (n,), of robots with motor angles [deg] (n, 12); heights: `make_ground`."""
    package = module.__package__.rpartition(".")[0]
    joint_q = joint_coordinates(pos, quat_xyzw, np.radians(motors_deg))
    flags = wp.zeros(len(joint_q), dtype=wp.int32, device="cpu")
    clearance = wp.zeros(len(joint_q), dtype=wp.float32, device="cpu")
    legs = leg_array(importlib.import_module(f"{package}.kinematics.geometry"))
    surface = make_ground(importlib.import_module(f"{package}.terrain.ground"), heights)
    inputs = [legs, surface, wp.array(joint_q.ravel(), dtype=wp.float32, device="cpu"), 43, margin]
    wp.launch(make_collision_kernel(package), len(joint_q), inputs=inputs, outputs=[flags, clearance], device="cpu")
    return flags.numpy(), clearance.numpy()


@wp.kernel
def category_kernel(
    legs: wp.array(dtype=LegGeometry), surface: Ground, joint_q: wp.array(dtype=wp.float32), bound: float,
    out: wp.array2d(dtype=wp.float32),
):  # fmt: skip
    """Write the smallest distance [m] of each category, in the order of FLAGS, to out (n, 8); one thread per robot."""
    world = wp.tid()
    start = 43 * world
    pos = vec3(joint_q[start], joint_q[start + 1], joint_q[start + 2])
    rotation = wp.quat_to_matrix(quat(joint_q[start + 3], joint_q[start + 4], joint_q[start + 5], joint_q[start + 6]))
    out[world, 0] = collision_module.body_ground_distance(surface, legs[0].shell, pos, rotation)
    for k in range(1, 5):
        out[world, k] = 1.0e6
    for k in range(5, 8):
        out[world, k] = bound
    for leg in range(4):
        capsules = collision_module.load_leg(legs, joint_q, 0, start, leg)
        over_ground = collision_module.leg_ground_distances(surface, capsules, pos, rotation)
        for k in range(4):
            out[world, 1 + k] = wp.min(out[world, 1 + k], over_ground[k])
        for earlier in range(leg):
            if leg + earlier != 3:  # not diagonal
                neighbour = collision_module.load_leg(legs, joint_q, 0, start, earlier)
                distance = collision_module.leg_leg_distance(capsules, neighbour, bound)
                out[world, 5] = wp.min(out[world, 5], distance)
        out[world, 6] = wp.min(out[world, 6], collision_module.leg_self_distance(capsules, bound))
        out[world, 7] = wp.min(out[world, 7], collision_module.leg_shell_distance(capsules, bound))


def category_distances(poses, bound=10.0, heights=None):
    """Return the distances [m] (n, 8) of FLAGS for poses (pos, quat_xyzw, motors [rad]), each (n, ...)."""
    joint_q = joint_coordinates(*poses)
    out = wp.zeros((len(joint_q), 8), dtype=wp.float32, device="cpu")
    surface = make_ground(heights=heights)
    inputs = [leg_array(), surface, wp.array(joint_q.ravel(), dtype=wp.float32, device="cpu"), bound]
    wp.launch(category_kernel, len(joint_q), inputs=inputs, outputs=[out], device="cpu")
    return out.numpy()


def transversal_angles(rng, count, low, high, sum_low, sum_high):
    """Return (outer, inner) [deg], (count, 2), uniform in low..high with their sum in sum_low..sum_high."""
    angles = rng.uniform(low, high, (8 * count, 2))
    inside = (angles.sum(axis=1) >= sum_low) & (angles.sum(axis=1) <= sum_high)
    return angles[inside][:count]


@cache
def random_poses():
    """Return (pos [m], quat_xyzw, motors [rad]) of 300 robots near the ground, in any attitude.

    Motor angles are within the hard stops, but the sum outer + inner begins 20 degrees below its stop.
    """
    rng = np.random.default_rng(7)
    motors = np.hstack(
        [
            np.column_stack([rng.uniform(-50, 110, 300), transversal_angles(rng, 300, -30, 140, -20, 240)])
            for _ in range(4)
        ]
    )
    pos = rng.uniform((-1, -1, 0.1), (1, 1, 0.7), (300, 3))
    return pos, Rotation.random(300, random_state=7).as_quat(), np.radians(motors)


# ---- oracle: link positions by rotations, distances by coal


def leg_points(leg, lateral, outer, inner):
    """Return points [m] (outer axis, inner axis, outer knee, inner knee, ankle; body frame) of a leg, angles [rad]."""
    front, side = LEGS[leg]
    hip = np.array([front * 0.1433, side * (0.105 if front > 0 else 0.150), 0.0])
    housing = Rotation.from_rotvec([side * lateral, 0, 0])
    axes = np.array([[front * 0.1417, side * 0.05945, 0.0], [front * 0.0517, side * 0.05945, 0.0]])
    hanging = [0.0, side * 0.00075, -0.175]
    knees = axes + [
        Rotation.from_rotvec([0, -front * outer, 0]).apply(hanging),
        Rotation.from_rotvec([0, front * inner, 0]).apply(hanging),
    ]
    across = complex(*(knees[1] - knees[0])[[0, 2]])
    shank = 0.3 * np.exp(1j * (np.angle(across) + front * np.arccos(abs(across) / 0.6)))
    ankle = knees[0] + [shank.real, 0.0, shank.imag]
    return hip + housing.apply(np.vstack([axes, knees, ankle]))


def links(points):
    """Return coal capsules of outer thigh, inner thigh, outer shank, inner shank and paw; points: `leg_points`."""
    outer_axis, inner_axis, outer_knee, inner_knee, ankle = points
    thighs = [capsule(outer_axis, outer_knee, THIGH), capsule(inner_axis, inner_knee, THIGH)]
    return [*thighs, *(capsule(knee, ankle, SHANK) for knee in (outer_knee, inner_knee)), capsule(ankle, ankle, PAW)]


def self_distance(points):
    """Return coal's smallest distance [m] between the links of a leg, shanks by their upper halves."""
    _, _, *knees, ankle = points
    outer_thigh, inner_thigh, outer_shank, inner_shank, _ = links(points)
    upper = [capsule(knee, (knee + ankle) / 2, SHANK) for knee in knees]
    pairs = ((outer_thigh, inner_thigh), (outer_thigh, inner_shank), (inner_thigh, outer_shank), upper)
    return min(coal_distance(*pair) for pair in pairs)


def ground_oracle(pos, quat_xyzw, points):
    """Return heights [m] over z = 0 of the lowest point of shell, housings, thighs, knees and shanks.

    points: (4, 5, 3), `leg_points` of all legs; shanks count down to 0.9 of their length, thighs to the middle.
    """
    turn = Rotation.from_quat(quat_xyzw)

    def height(body_points):  # [m] over z = 0 of the lowest of points in the body frame
        return np.min(pos[Z] + turn.apply(np.reshape(body_points, (-1, 3)))[:, Z])

    corners = [
        np.where(pick, high, low)
        for low, high in (NOSE, TRUNK, FRONT_DRUMS, REAR_DRUMS)
        for pick in np.ndindex(2, 2, 2)
    ]
    hips = np.array([[front * 0.1433, side * (0.105 if front > 0 else 0.150), 0.0] for front, side in LEGS])
    tips = hips + [[front * 0.19, 0.0, 0.0] for front, _ in LEGS]
    axes, knees = points[:, :2], points[:, 2:4]
    lower_shank = knees + 0.9 * (points[:, 4:] - knees)
    return (
        height(corners),
        height([hips, tips]) - HOUSING,
        height([axes, (axes + knees) / 2]) - THIGH,
        height(knees) - THIGH,
        height([knees, lower_shank]) - SHANK,
    )


@cache
def oracle_distances():
    """Return coal's distances [m] (300, 8) of `random_poses`, in the order of FLAGS."""
    pos, quat_xyzw, motors = random_poses()
    out = []
    for robot in range(len(pos)):
        points = np.array([leg_points(leg, *motors[robot, 3 * leg : 3 * leg + 3]) for leg in range(4)])
        bars = [links(p) for p in points]
        leg_leg = min(coal_distance(a, b) for leg, other in NEIGHBOURS for a in bars[leg] for b in bars[other])
        shells = [[box(*NOSE), box(*TRUNK), box(*(REAR_DRUMS if front > 0 else FRONT_DRUMS))] for front, _ in LEGS]
        leg_shell = min(coal_distance(a, b) for leg in range(4) for a in bars[leg] for b in shells[leg])
        leg_self = min(self_distance(p) for p in points)
        out.append((*ground_oracle(pos[robot], quat_xyzw[robot], points), leg_leg, leg_self, leg_shell))
    return np.array(out)


# ---- whole robot


@pytest.mark.parametrize("category", range(8), ids=FLAGS)
def test_category_distance_agrees_with_coal(category):
    ours = category_distances(random_poses())[:, category]
    np.testing.assert_allclose(ours, oracle_distances()[:, category], atol=1e-5)  # [m]


@pytest.mark.parametrize("bound", [0.0, 0.01, 0.1])  # [m]
def test_distances_between_links_with_a_bound_are_the_minimum_of_distance_and_bound(bound):
    between_links = slice(FLAGS.index("LEG_LEG"), None)  # LEG_LEG, LEG_SELF, LEG_SHELL
    full, bounded = (category_distances(random_poses(), each)[:, between_links] for each in (10.0, bound))
    np.testing.assert_allclose(bounded, np.minimum(full, bound), atol=1e-6)


@pytest.mark.parametrize("margin", [0.0, 0.02, 5.0])  # [m]
def test_flags_and_clearance_agree_with_coal(margin):
    """A flag is raised where its distance is negative; clearance is the smallest distance, at most the margin."""
    pos, quat_xyzw, motors = random_poses()
    flags, clearance = collide(pos, quat_xyzw, np.degrees(motors), margin)
    expected = oracle_distances()
    np.testing.assert_allclose(clearance, np.minimum(expected.min(axis=1), margin), atol=1e-5)
    beyond_rounding = np.abs(expected) > 1e-5  # [m]
    raised = (flags[:, None] & MASKS) != 0
    np.testing.assert_array_equal(raised[beyond_rounding], (expected < 0)[beyond_rounding])
    assert raised.any(axis=0).all(), "every flag occurs among the poses"


def test_clearance_is_equal_in_double_precision():
    float64_kernels()
    module = importlib.import_module("jumper_warp.kernels_float64.collision.robot")
    pos, quat_xyzw, motors = random_poses()
    _, clearance = collide(pos, quat_xyzw, np.degrees(motors))
    _, expected = collide(pos, quat_xyzw, np.degrees(motors), module=module)
    np.testing.assert_allclose(clearance, expected, atol=2e-6)  # [m]


LEVEL = (0.0, 0.0, 0.0, 1.0)  # xyzw
STAND = (0, 45, 45) * 4  # [deg] lateral, outer, inner of FL, FR, BL, BR


def workspace(count):
    """Return motor angles [deg] (count, 12), random in the range that the jumping tasks use."""
    rng = np.random.default_rng(11)
    legs = [(rng.uniform(-15, 15, count), transversal_angles(rng, count, -10, 135, 0, 230)) for _ in range(4)]
    return np.hstack([np.column_stack(leg) for leg in legs])


def test_legs_touch_in_the_jumping_workspace_rarely_and_only_where_one_reaches_far_inward():
    motors = workspace(20000)
    inward = np.abs(motors[:, 2::3] - motors[:, 1::3]).max(axis=1)  # largest |inner - outer| of the legs [deg]
    flags, _ = collide((0, 0, 2), LEVEL, motors, margin=0.0)
    assert 0.0 < np.mean(flags != 0) < 0.01
    assert not np.any(flags & ~collision_module.LEG_LEG)  # nor with themselves or the shell
    assert not np.any(flags[inward < 80.0])


# ---- heightfield


@pytest.mark.parametrize(("height", "raised"), [(0.34, False), (0.36, True)])  # height of the mesa [m]
def test_shell_corner_inside_a_mesa_raises_body_ground(height, raised):
    # the shell's bottom stands at 0.397 - 0.049 = 0.348; of it only the left rear drums, x -0.144, y 0.199, overlap
    # the mesa x < -0.13, 0.18 < y < 0.205; the paws stand outside
    heights = np.zeros((801, 801))
    y, x = np.meshgrid(np.linspace(-2, 2, 801), np.linspace(-2, 2, 801), indexing="ij")
    heights[(x < -0.13) & (x > -0.16) & (y > 0.18) & (y < 0.21)] = height
    flags, _ = collide((0, 0, 0.397), LEVEL, STAND, heights=heights)
    assert bool(flags[0] & collision_module.BODY_GROUND) == raised


def test_slope_agrees_with_level_ground_seen_from_a_tilted_frame():
    slope = np.radians(20.0)
    heights = np.tile(np.linspace(-2, 2, 61) * np.tan(slope), (61, 1))
    tilt = Rotation.from_rotvec([0, -slope, 0])
    pos, quat_xyzw, motors = random_poses()
    tilted = tilt * Rotation.from_quat(quat_xyzw)
    ours = category_distances((tilt.apply(pos), tilted.as_quat(), motors), heights=heights)
    level = category_distances(random_poses())
    of_legs = slice(FLAGS.index("HOUSING_GROUND"), FLAGS.index("SHANK_GROUND") + 1)
    np.testing.assert_allclose(ours[:, of_legs], level[:, of_legs], atol=2e-5)  # [m]
    # the shell is tested at the corners that are lower in the world, so both attitudes must agree on which these are
    same_side = Rotation.from_quat(quat_xyzw).as_matrix()[:, 2, 2] * tilted.as_matrix()[:, 2, 2] > 0
    body = FLAGS.index("BODY_GROUND")
    np.testing.assert_allclose(ours[same_side, body], level[same_side, body], atol=2e-5)
