"""Attitude control in free flight: starts, goals, observations, success, metrics of turns, and conserved momentum."""

import dataclasses

import numpy as np
import pinocchio as pin
import pytest
import torch
from scipy.spatial.transform import Rotation

from columns import MOTOR_COORDS, MOTOR_DOFS, Z
from jumper_warp.envs.env import Env
from jumper_warp.evaluation.attitude import TURN_METRICS, AttitudeLog, axis_metrics, axis_turns
from jumper_warp.evaluation.log import run_evaluation
from jumper_warp.registry import make_task
from jumper_warp.tasks.attitude.cfg import AttitudeResetCfg, TurnCfg
from jumper_warp.tasks.mirror import mirror_of
from jumper_warp.utils.metrics import measure
from momentum_oracle import momentum, rotational_inertia
from pinocchio_model import build_pinocchio
from velocity_helpers import edit

N = 64
DEG = np.pi / 180.0


@pytest.fixture(scope="module")
def env():
    """Nominal worlds with episodes of half a second; each test resets them."""
    task = make_task("attitude")
    task = dataclasses.replace(
        task,
        reset=dataclasses.replace(task.reset, settings=AttitudeResetCfg(episode=(0.5, 0.5))),
        levels=(TurnCfg((20, 90)),),
    )
    return Env(task, N, seed=3, device="cpu", randomize=False, noise=False)


def rotate_yaw(quat, goal):
    """Return the rotations from orientations to goals, both quaternions xyzw (n, 4), in body axes."""
    return Rotation.from_quat(quat).inv() * Rotation.from_quat(goal)


def test_episodes_begin_at_rest_in_the_air_in_any_attitude_with_a_goal_of_the_level(env):
    env.reset()
    arrays, q = env.task_arrays(), env.sim.joint_q()
    angle = rotate_yaw(arrays["base_quat"], arrays["goal"]).magnitude() / DEG
    assert angle.min() > 20.0 - 1e-3 and angle.max() < 90.0 + 1e-3 and angle.std() > 10.0
    np.testing.assert_allclose(arrays["error"], angle * DEG, atol=1e-5)
    up = Rotation.from_quat(arrays["base_quat"]).apply([0.0, 0.0, 1.0])
    assert up[:, Z].min() < -0.8 and up[:, Z].max() > 0.8 and np.abs(up.mean(axis=0)).max() < 0.3
    assert (arrays["base_pos"] == [0.0, 0.0, 2.0]).all() and not env.sim.joint_qd().any()
    legs = q[:, MOTOR_COORDS].reshape(N, 4, 3)
    default = (np.abs(q[:, MOTOR_COORDS] - env.robot.default_angle.numpy()) < 1e-6).all(axis=1)
    assert 0.1 < default.mean() < 0.6
    assert (legs[~default, :, 0] >= -20.0 * DEG).all() and (legs[~default, :, 0] <= 80.0 * DEG).all()
    assert legs[~default, :, 1:].min() >= 0.0 and legs[~default].std(axis=0).min() > 0.2
    env.step(torch.zeros(N, 12))
    assert not env.robot.collisions.numpy().any()


def test_the_remaining_rotation_is_observed(env):
    obs = env.reset()[0]["actor"].numpy()
    arrays = env.task_arrays()
    first, end = env.task.layout("actor")["turn_left"]
    expected = rotate_yaw(arrays["base_quat"], arrays["goal"]).as_quat(canonical=True)
    np.testing.assert_allclose(obs[:, first:end], expected, atol=1e-5)
    mirror = mirror_of(env.task, "actor")
    flip = np.diag([1.0, -1.0, 1.0])
    reflected = Rotation.from_matrix(flip @ Rotation.from_quat(expected).as_matrix() @ flip).as_quat(canonical=True)
    np.testing.assert_allclose((mirror.signs * obs[:, mirror.order])[:, first:end], reflected, atol=1e-5)


def test_an_episode_succeeds_within_tolerance_and_without_collision(env):
    env.reset()
    goal, aside = env.task_arrays()["base_quat"].copy(), Rotation.from_euler("x", 30, degrees=True)
    goal[1] = (Rotation.from_quat(goal[1]) * aside).as_quat()
    env.metrics()
    edit(env, goal=goal)
    edit(env, 2, collisions=1)
    hold = (env.sim.joint_q()[:, MOTOR_COORDS] - env.robot.default_angle.numpy()) / (90.0 * DEG)
    action = torch.tensor(hold, dtype=torch.float32)
    for _ in range(30):
        step = env.step(action)
    assert step.truncated.all() and not step.terminated.any()
    names = [term.name for term in env.task.terminations]
    ends = [names[i] for i in env.episodes.termination.numpy()]
    assert ends[2] == "ended" and ends.count("ended_clear") == N - 1
    metrics = env.metrics()
    assert metrics["Metrics/success"] == pytest.approx((N - 2) / N)
    assert metrics["Metrics/settled"] == pytest.approx((N - 1) / N)
    assert metrics["Metrics/settling_time_of_settled_s"] == pytest.approx(1.0 / 60.0)
    assert metrics["Metrics/error_at_end_rad"] == pytest.approx(30.0 * DEG / N, abs=2e-3)


def test_momentum_and_inertia_agree_with_pinocchio(env):
    env.reset()
    for _ in range(5):
        env.step(torch.rand(N, 12) - 0.5)
    robot, (linear, angular), inertia = build_pinocchio(), momentum(env.sim), rotational_inertia(env.sim)
    com = env.sim.model.body_com.numpy()[0]
    for i in range(4):
        q, qd = env.sim.joint_q()[i].astype(float), env.sim.joint_qd()[i].astype(float)
        turn = Rotation.from_quat(q[3:7])
        spin = turn.inv().apply(qd[3:6])
        twist = np.concatenate([turn.inv().apply(qd[:3]) - np.cross(spin, com), spin])
        full = robot.configuration(q[:3], q[3:7] / np.linalg.norm(q[3:7]), q[MOTOR_COORDS])
        v = robot.closed_velocity(full, twist, qd[MOTOR_DOFS])
        expected = pin.computeCentroidalMomentum(robot.model, robot.data, full, v).vector
        assert np.abs(qd).max() > 1.0
        np.testing.assert_allclose(np.concatenate([linear[i], angular[i]]), expected, atol=1e-4)
        pin.ccrba(robot.model, robot.data, full, v)
        np.testing.assert_allclose(inertia[i], robot.data.Ig.inertia, atol=1e-4)


def stroke(seconds, hertz=2.0, reach=0.35):
    """Return the action (12,) of paws circling in the sagittal plane, with legs stretched in one direction."""
    angle = 2.0 * np.pi * hertz * seconds
    front = np.array([1.0, 1.0, -1.0, -1.0])[:, None]
    swing, fold = front * reach * np.sin(angle), reach * np.cos(angle)
    return np.hstack([np.zeros((4, 1)), fold + swing, fold - swing]).ravel()


def test_leg_motions_turn_the_robot_without_angular_momentum(env):
    env.evaluation_reset([0.0, 0.0, 0.0, 1.0])
    start, drift = env.task_arrays()["base_quat"], []
    backward = np.where(np.arange(N) % 2 == 0, 1.0, -1.0)
    for i in range(120):
        action = np.array([stroke(i / 60.0 * sign) for sign in backward])
        env.step(torch.tensor(action, dtype=torch.float32))
        drift.append(np.linalg.norm(momentum(env.sim)[1], axis=1))
    angle = rotate_yaw(start, env.task_arrays()["base_quat"]).as_euler("YXZ", degrees=True)[:, 0]
    assert (angle * backward).max() < -15.0
    assert np.max(drift) < 1.0e-5  # [kg m^2/s]; 0.010 without the momentum projection


def test_turn_metrics_have_error_settling_time_and_success(env):
    turns = AttitudeLog(axis_turns(N, 90.0), seconds=0.2)
    run_evaluation(lambda obs: torch.zeros(N, 12), env, turns)
    np.testing.assert_allclose(env.task_arrays()["base_pos"][:, Z], 2.35, atol=0.05)
    np.testing.assert_allclose(np.degrees(turns.error), 90.0, atol=5.0)
    axis = Rotation.from_quat(turns.turns[:6]).as_rotvec() / DEG
    np.testing.assert_allclose(axis, 90.0 * np.repeat(np.eye(3), 2, axis=0) * np.tile([[1], [-1]], (3, 1)), atol=1e-9)

    def success():  # share of turns that settled without collision
        return measure(TURN_METRICS, turns)["settled_without_collision_rate"].value

    assert success() == 0.0 and axis_metrics(turns)["roll_plus_settling_time_mean_s"].value is None
    turns.errors = [np.full(N, e) * DEG for e in (40.0, 3.0, 8.0, 4.0, 2.0)]
    np.testing.assert_allclose([turns.first_time[0], turns.settling_time[0]], [2.0 / 60.0, 4.0 / 60.0])
    assert success() == 1.0
    turns.collided[:] = np.arange(N) < 16
    assert success() == 0.75
