"""The project's robot description against the numbers of the paper and hand calculations."""

import math

import numpy as np
import pytest

from jumper_warp.robot.description import LEGS, MOTOR_JOINTS, knee_angles, leg_dimensions, load_description


@pytest.fixture(scope="module")
def description():
    """Return the description of the robot."""
    return load_description()


def test_total_mass_is_14_5_kg(description):
    assert description.mass == pytest.approx(14.5, abs=1e-12)


@pytest.mark.parametrize(
    ("motor", "armature", "no_load", "cutoff", "peak"),  # index in the leg, [kg m^2], [rad/s], [rad/s], [N m]
    [(0, 4.69e-3, 49.2, 35.1, 18.0), (1, 4.14e-3, 40.0, 23.6, 24.8), (2, 4.14e-3, 40.0, 23.6, 24.8)],
    ids=["lateral", "outer", "inner"],
)
def test_constants_of_back_right_motors(description, motor, armature, no_load, cutoff, peak):
    constants = description.motors[motor + 9]  # the last leg
    assert constants.armature == pytest.approx(armature, rel=1e-4)
    assert constants.no_load_speed == pytest.approx(no_load, rel=1e-3)
    assert constants.cutoff_speed == pytest.approx(cutoff, rel=2e-3)
    assert constants.peak_torque == peak


def test_paw_is_merged_into_the_inner_shank_by_the_parallel_axis_theorem(description):
    shank = description.link("FL_inner_shank")
    # shank of 0.1993 kg at (-0.0183, 0, -0.1819) m, paw of 0.020 kg at (0, 0, -0.3) m
    assert shank.mass == pytest.approx(0.2193)
    assert shank.com == pytest.approx([-0.0166311, 0.0, -0.1926707], abs=1e-7)
    # reduced mass 0.018176 kg, offset (0.0183, 0, -0.1181): Ixx += m z^2, Iyy += m (x^2 + z^2), Ixz -= m x z
    assert np.diag(shank.inertia) == pytest.approx([1.65351e-3, 1.66960e-3, 3.6087e-5], rel=1e-5)
    assert shank.inertia[0, 2] == pytest.approx(-6.7e-5 + 3.9283e-5, rel=1e-3)


@pytest.mark.parametrize("leg", ["FL", "BR"])
@pytest.mark.parametrize(("degrees", "depth"), [(0, 0.4716), (45, 0.3718)])  # both thighs; [m]
def test_knee_angles_and_ankle_depth_of_a_symmetric_leg(description, leg, degrees, depth):
    angle = math.radians(degrees)
    outer_knee, inner_knee, ankle_z = knee_angles(leg_dimensions(description, leg), angle, angle)
    assert -ankle_z == pytest.approx(depth, abs=5e-5)
    # the leg is symmetric: each shank leans by asin((0.045 + 0.175 sin q) / 0.3)
    lean = math.asin((0.045 + 0.175 * math.sin(angle)) / 0.3)
    assert (outer_knee, inner_knee) == pytest.approx((angle + lean, angle + lean))


@pytest.mark.parametrize("leg", LEGS)
def test_leg_mirrors_the_front_left_one_but_for_the_places_of_the_hips(description, leg):
    flip = np.array([1.0 if leg[0] == "F" else -1.0, 1.0 if leg[1] == "L" else -1.0, 1.0])  # signs of x, y, z
    for link in (link for link in description.links if link.name.startswith(leg)):
        twin = description.link(f"FL{link.name[2:]}")
        assert (link.mass, len(link.collisions)) == (twin.mass, len(twin.collisions))
        np.testing.assert_allclose(link.com, flip * twin.com, atol=1e-6)
        np.testing.assert_allclose(link.inertia, np.outer(flip, flip) * twin.inertia, atol=1e-9)
    for joint in (joint for joint in description.joints if joint.name.startswith(leg)):
        twin = description.joint(f"FL{joint.name[2:]}")
        origin = flip * twin.origin
        if joint.name.endswith("lateral"):
            origin[1] = flip[1] * abs(joint.origin[1])
        np.testing.assert_allclose(joint.origin, origin, atol=1e-6)
        np.testing.assert_allclose(np.abs(joint.axis), np.abs(twin.axis), atol=1e-6)
        assert (joint.lower, joint.upper) == (twin.lower, twin.upper)
    loop = description.loops[LEGS.index(leg)]
    assert (loop.parent, loop.child) == (f"{leg}_inner_shank", f"{leg}_outer_shank")
    paw = description.link(loop.parent).collisions[0]
    for anchor in (loop.parent_anchor, loop.child_anchor, paw.position):
        assert anchor.tolist() == [0.0, 0.0, -0.3]


def test_inertia_tensors_are_those_of_mass_distributions(description):
    for link in description.links:
        low, middle, high = np.linalg.eigvalsh(link.inertia)
        assert 0.0 < low and high <= (low + middle) * (1.0 + 1e-9)


def test_limits_of_the_urdf_are_those_of_the_motors_and_poses_are_within_the_stops(description):
    for name, motor in zip(MOTOR_JOINTS, description.motors, strict=True):
        joint = description.joint(name)
        assert (joint.effort, joint.velocity) == pytest.approx((motor.peak_torque, motor.no_load_speed), rel=1e-3)
        assert all(joint.lower <= description.pose(pose)[MOTOR_JOINTS.index(name)] <= joint.upper
                   for pose in description.poses)  # fmt: skip
