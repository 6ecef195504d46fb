"""Kinematics, momentum and clearance against the simulation's kernels."""

from typing import NamedTuple

import newton
import numpy as np
import pytest
import torch
import warp as wp
from scipy.spatial.transform import Rotation

from columns import ANG_VEL, LIN_VEL, MOTOR_COORDS, MOTOR_DOFS, POS, QUAT, Z
from jumper_warp.diff.rollout import Rollout, compact
from jumper_warp.kernels.collision import robot as collision
from jumper_warp.kernels.layout import COORDS
from jumper_warp.robot.model import build_model
from jumper_warp.sim.dynamics import JumperDynamics
from jumper_warp.trajectory.whole_body import WholeBody

N = 6  # worlds


class Links(NamedTuple):
    """N robots in random states, and the world poses and twists of their 21 links by the simulation's kernels."""

    model: newton.Model
    body: WholeBody
    q: torch.Tensor  # (N, 19) base pose and motor angles
    qd: torch.Tensor  # (N, 18)
    pose: np.ndarray  # (N, 21, 7) position [m], quaternion xyzw
    twist: np.ndarray  # (N, 21, 6) velocity of the com [m/s], angular velocity [rad/s]


@pytest.fixture(scope="module")
def links():
    """Return the `Links`."""
    rng, model = np.random.default_rng(0), build_model(N, visuals=False)
    joint_q, joint_qd = np.zeros((N, 43)), np.zeros((N, 38))
    angles = rng.uniform(0.2, 1.5, (N, 4, 3)) * [0.2, 1.0, 1.0]
    joint_q[:, POS] = [0.0, 0.0, 1.0] + rng.normal(size=(N, 3))
    joint_q[:, QUAT] = Rotation.random(N, random_state=rng).as_quat()
    joint_q[:, MOTOR_COORDS] = angles.reshape(N, 12)
    joint_qd[:, :6], joint_qd[:, MOTOR_DOFS] = rng.normal(size=(N, 6)), 4.0 * rng.normal(size=(N, 12))
    state = model.state()
    state.joint_q.assign(joint_q.ravel().astype(np.float32))
    state.joint_qd.assign(joint_qd.ravel().astype(np.float32))
    JumperDynamics(model).full_state(state.joint_q, state.joint_qd, state.body_q, state.body_qd)
    pose, twist = state.body_q.numpy().reshape(N, 21, 7), state.body_qd.numpy().reshape(N, 21, 6)
    q, qd = (torch.as_tensor(rows.T) for rows in compact(joint_q, joint_qd, N))
    return Links(model, WholeBody(Rollout(model, double=True)), q, qd, pose, twist)


def test_link_poses_match_the_kernels(links):
    _, body, q, qd, pose, _ = links
    frames = body.legs(q, qd)
    rotation = Rotation.from_quat(pose[:, 1:, 3:].reshape(-1, 4)).as_matrix().reshape(N, 20, 3, 3)
    assert frames.pos.flatten(1, 2).numpy() == pytest.approx(pose[:, 1:, :3], abs=1e-6)  # [m]
    assert frames.rotation.flatten(1, 2).numpy() == pytest.approx(rotation, abs=1e-6)


def test_points_match_leg_frames(links):
    _, body, q, qd, _, _ = links
    for points, expected in zip(body.points(q), (body.legs(q, qd).pos, body.legs(q, qd).ankle), strict=True):
        assert torch.allclose(points, expected, atol=1e-12)  # [m]


def test_momentum_and_base_velocity_match_link_twists(links):
    """The oracle sums mass, momentum and inertia over the model's 21 links."""
    model, body, q, qd, pose, twist = links
    mass = model.body_mass.numpy().reshape(N, 21, 1).astype(float)
    rotation = Rotation.from_quat(pose[..., QUAT].reshape(-1, 4)).as_matrix().reshape(N, 21, 3, 3)
    lin_vel, ang_vel = twist[..., LIN_VEL], twist[..., ANG_VEL]
    center = pose[..., POS] + (rotation @ model.body_com.numpy().reshape(N, 21, 3, 1))[..., 0]
    com, vel = ((mass * x).sum(1) / mass.sum(1) for x in (center, lin_vel))  # of the robot
    inertia = rotation @ model.body_inertia.numpy().reshape(N, 21, 3, 3) @ rotation.swapaxes(-1, -2)
    arm, moving = center - com[:, None], lin_vel - vel[:, None]  # relative to the robot's com
    spin = ((inertia @ ang_vel[..., None])[..., 0] + mass * np.cross(arm, moving)).sum(1)
    square = (arm**2).sum(-1)[..., None, None] * np.eye(3) - arm[..., None] * arm[..., None, :]
    whole = (inertia + mass[..., None] * square).sum(1)
    for value, expected in zip(body.momentum(q, qd), (com, vel, spin, whole), strict=True):
        assert value.numpy() == pytest.approx(expected, abs=1e-5)  # [m], [m/s], [kg m^2/s], [kg m^2]
    base = 0  # link
    origin_velocity = lin_vel[:, base] - np.cross(ang_vel[:, base], rotation[:, base] @ model.body_com.numpy()[base])
    assert body.base_velocity(q, qd).numpy() == pytest.approx(origin_velocity, abs=1e-5)  # [m/s]


def test_clearance_matches_collision_kernel(links):
    """The kernel reports no contact with a kind of link 1 mm above the ground, and contact 1 mm below."""
    model, body, q, _, _, _ = links
    flags = (collision.HOUSING_GROUND, collision.THIGH_GROUND, collision.KNEE_GROUND, collision.SHANK_GROUND)
    gaps = body.clearance(q).amin(1).numpy()  # (N, kinds) [m]
    dynamics = JumperDynamics(model)
    for kind, flag in enumerate(flags):
        for depth, touches in ((-0.001, False), (0.001, True)):  # [m] below the ground
            joint_q = np.zeros((N, int(COORDS)), dtype=np.float32)
            joint_q[:, :7] = q[:, :7].numpy()  # base pose
            joint_q[:, Z] -= gaps[:, kind] + depth
            joint_q[:, MOTOR_COORDS] = q[:, 7:].numpy()
            flags_out, distance = wp.zeros(N, dtype=int), wp.zeros(N, dtype=float)
            wp.launch(
                collision.collision_kernel, dim=N,
                inputs=[dynamics.robot.geometry, dynamics.robot.ground, wp.array(joint_q.ravel()), int(COORDS), 0.0],
                outputs=[flags_out, distance],
            )  # fmt: skip
            assert ((flags_out.numpy() & int(flag)) != 0).tolist() == [touches] * N, (kind, depth)
