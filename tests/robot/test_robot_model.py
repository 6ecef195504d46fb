"""Newton's model of the robot: layout, poses, contacts and dynamics, against hand calculations and Pinocchio."""

import dataclasses
import math

import newton
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from columns import COORDS, DOFS, POS, X, Y, Z
from jumper_warp.robot.description import load_description
from jumper_warp.robot.model import build_model, leg_geometry, standing_configuration
from jumper_warp.sim.mujoco import mujoco_solver

LEGS = ("FL", "FR", "BL", "BR")
FRONT = np.array([1, 1, -1, -1])  # sign of x by leg
SIDE = np.array([1, -1, 1, -1])  # sign of y by leg


@pytest.fixture(scope="module")
def description():
    """Return the description of the robot."""
    return load_description()


@pytest.fixture(scope="module")
def model():
    """Return Newton's model of two robots in the default pose on a plane."""
    return build_model(2, device="cpu")


def body_poses(model, joint_q):
    """Return world 0's link positions (21, 3) [m] and 21 rotations, world frame, for joint_q (43,)."""
    state = model.state()
    coords = state.joint_q.numpy()
    coords[:COORDS] = joint_q
    state.joint_q.assign(coords)
    newton.eval_fk(model, state.joint_q, state.joint_qd, state)
    poses = state.body_q.numpy()[:21].astype(float)
    return poses[:, POS], Rotation.from_quat(poses[:, 3:])


def far_ends(model, joint_q, link, length):
    """Return positions (4, 3) [m], world frame, of the points (0, 0, -length [m]) of link 0 to 4 of each leg."""
    positions, rotations = body_poses(model, joint_q)
    bodies = [1 + 5 * leg + link for leg in range(4)]
    return positions[bodies] + rotations[bodies].apply([0.0, 0.0, -length])


def test_labels_and_layout(model):
    per_leg = ["lateral", "outer", "outer_knee", "inner", "inner_knee"]
    joints = ["base", *(f"{leg}_{joint}" for leg in LEGS for joint in per_leg), *(f"{leg}_ankle" for leg in LEGS)]
    links = ["housing", "outer_thigh", "outer_shank", "inner_thigh", "inner_shank"]
    bodies = ["body", *(f"{leg}_{link}" for leg in LEGS for link in links)]
    assert model.joint_label == [f"world_{world}/{joint}" for world in (0, 1) for joint in joints]
    assert model.body_label == [f"world_{world}/{body}" for world in (0, 1) for body in bodies]
    assert (model.joint_coord_count, model.joint_dof_count) == (2 * COORDS, 2 * DOFS)
    starts = np.array([0, *range(7, 27), *range(27, COORDS, 4)])
    assert model.joint_q_start.numpy()[:-1].tolist() == [*starts, *(COORDS + starts)]
    assert model.joint_qd_start.numpy()[:25].tolist() == [0, *range(6, 26), 26, 29, 32, 35]


def test_masses_and_inertias_match_description(model, description):
    masses = model.body_mass.numpy().reshape(2, 21)
    assert masses.sum(axis=1) == pytest.approx([14.5, 14.5], rel=1e-6)
    inertia = np.array([link.inertia for link in description.links])
    assert model.body_inertia.numpy()[21:] == pytest.approx(inertia, rel=1e-6, abs=1e-12)


def test_motor_and_knee_properties(model):
    def legs(array):
        """Return world 1's values by leg and joint, (4, 5): lateral, outer, outer knee, inner, inner knee."""
        return array.numpy().reshape(2, DOFS)[1, 6:26].reshape(4, 5)

    assert legs(model.joint_armature) == pytest.approx(np.tile([4.69e-3, 4.14e-3, 0, 4.14e-3, 0], (4, 1)), rel=1e-3)
    assert legs(model.joint_friction) == pytest.approx(np.tile([0.02, 0.02, 0, 0.02, 0], (4, 1)))
    assert legs(model.joint_damping) == pytest.approx(np.tile([0, 0, 0.1, 0, 0.1], (4, 1)))
    assert np.degrees(legs(model.joint_limit_lower))[:, [0, 1, 3]] == pytest.approx(np.tile([-50, -30, -30], (4, 1)))
    assert np.degrees(legs(model.joint_limit_upper))[:, [0, 1, 3]] == pytest.approx(np.tile([110, 140, 140], (4, 1)))


def test_default_pose_stands_on_closed_legs(model):
    joint_q = model.joint_q.numpy()[COORDS:]  # of world 1
    # base height: ankle depth 0.3718 at 45 degrees plus the paw radius
    assert joint_q[Z] == pytest.approx(0.3718 + 0.025, abs=5e-5)
    outer, inner = (far_ends(model, joint_q, link, length=0.3) for link in (2, 4))  # ankles by both shanks
    assert inner == pytest.approx(outer, abs=1e-6)
    assert inner[:, Z] == pytest.approx(np.full(4, 0.025), abs=1e-6)
    # below the middle between the transversal axes, x = 0.1433 + (0.1417 + 0.0517) / 2; y: hip + 0.05945 + 0.00075
    assert inner[:, X] == pytest.approx(0.24 * FRONT, abs=1e-6)
    assert inner[:, Y] == pytest.approx(SIDE * (np.array([0.105, 0.105, 0.15, 0.15]) + 0.0602), abs=1e-6)


def test_loop_coordinates_are_relative_rotations_of_shanks(model):
    joint_q = model.joint_q.numpy()[:COORDS]
    _, rotations = body_poses(model, joint_q)
    for leg in range(4):
        relative = rotations[5 + 5 * leg].inv() * rotations[3 + 5 * leg]  # outer shank in the inner one's frame
        stored = Rotation.from_quat(joint_q[27 + 4 * leg : 31 + 4 * leg])
        assert (stored.inv() * relative).magnitude() < 1e-6


@pytest.mark.parametrize(
    # joint and link among the five of a leg, length [m], axis, side to which the link's end moves (1: outward), [m]
    ("joint", "link", "length", "axis", "side", "least"),
    [(0, 4, 0.3, Y, SIDE, 0.03), (1, 1, 0.175, X, FRONT, 0.01), (3, 3, 0.175, X, -FRONT, 0.01),
     (2, 2, 0.3, X, -FRONT, 0.01), (4, 4, 0.3, X, FRONT, 0.01)],
    ids=["lateral", "outer thigh", "inner thigh", "outer knee", "inner knee"],
)  # fmt: skip
def test_positive_angle_moves_the_end_of_a_link(model, joint, link, length, axis, side, least):
    joint_q = model.joint_q.numpy()[:COORDS].astype(float)
    before = far_ends(model, joint_q, link, length)
    joint_q[7 + joint : 27 : 5] += 0.1  # [rad]
    moved = far_ends(model, joint_q, link, length) - before
    assert (side * moved[:, axis] > least).all()


def test_standing_height_with_the_legs_swung_outward(model, description):
    swung = dataclasses.replace(description, poses={"swung": (math.radians(30.0), math.radians(60.0))})
    paws = far_ends(model, standing_configuration(swung, "swung"), 4, 0.3)
    # the hips are level, and all legs have equal angles
    assert paws[:, Z] == pytest.approx(np.full(4, 0.025), abs=1e-6)


def test_leg_geometry_matches_joint_origins(description):
    front_left = leg_geometry(description)[0]
    assert front_left == {
        "hip": (0.1433, 0.105, 0.0), "front": 1.0, "side": 1.0, "outer_x": 0.1417, "inner_x": 0.0517,
        "plane_y": 0.05945, "knee_y": 0.00075, "thigh": 0.175, "shank": 0.3, "paw_radius": 0.025,
        "outer_shank": 0.3, "paw_offset": 0.0, "thigh_radius": 0.019, "shank_radius": 0.012, "housing_radius": 0.048,
        "housing_length": 0.19, "shell": (1.0, 1.0, 1.0),
    }  # fmt: skip


def test_only_paws_collide_with_the_ground():
    solver = mujoco_solver(build_model(1, visuals=False, device="cpu"))
    kind, affinity = solver.mj_model.geom_contype, solver.mj_model.geom_conaffinity
    collides = (kind[:, None] & affinity[None, :]) | (kind[None, :] & affinity[:, None])
    # the ground belongs to no world and comes first
    assert collides[0, 1:].all()
    assert not collides[1:, 1:].any()


def test_robot_slides_on_mujoco_with_the_least_friction():
    model = build_model(1, friction=0.005, visuals=False, device="cpu")
    solver, state, control = mujoco_solver(model), model.state(), model.control()
    rates = state.joint_qd.numpy()
    rates[0] = 3.0  # [m/s]
    state.joint_qd.assign(rates)
    for _ in range(48):  # 0.1 s
        solver.step(state, state, control, None, 1.0 / 480.0)
    # 3 m/s for 0.1 s, less 0.005 g t^2 / 2
    assert state.joint_q.numpy()[0] == pytest.approx(0.3, abs=0.002)


def test_paws_touch_a_heightfield_at_its_height():
    heights = np.full((21, 21), 0.1, dtype=np.float32)
    heights[0, 0] = 0.0  # a constant field has no range to scale
    ground = newton.Heightfield(data=heights, nrow=21, ncol=21, hx=2.0, hy=2.0)
    model = build_model(1, ground=ground, visuals=False, device="cpu")
    joint_q = model.joint_q.numpy()
    joint_q[2] += 0.099  # [m] 1 mm into the ground
    model.joint_q.assign(joint_q)
    solver = mujoco_solver(model)
    state = model.state()
    solver.step(state, state, model.control(), None, 1.0 / 480.0)
    contacts = solver.mjw_data.nacon.numpy()[0]
    assert contacts >= 4
    assert solver.mjw_data.contact.dist.numpy()[:contacts].min() == pytest.approx(-0.001, abs=2e-4)
