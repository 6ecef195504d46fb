"""State after a reset: independent of earlier episodes and of threads per world; motors at rest have no torque."""

import dataclasses

import numpy as np
import pytest
import torch
import warp as wp

from ground_helpers import hardest
from jump_helpers import make_env, only, random_actions, resetting
from jumper_warp.envs.env import Env
from jumper_warp.kernels.mdp.attempts import LANES
from jumper_warp.registry import TASKS, make_task

N, LANE_WORLDS = 4, 96


def differences(a: Env, b: Env) -> list[str]:
    """Return the names of the arrays in which the states of two environments differ."""
    first, second = a.state_dict(), b.state_dict()
    return [name for name in first if not torch.equal(first[name], second[name])]


def pushed(task):
    """Return a task in which a push acts on the base all the time, if the task has pushes."""
    return dataclasses.replace(task, randomization=dataclasses.replace(task.randomization, push_probability=1.0))


@pytest.mark.parametrize(("name", "solver"), [*((name, "jumper") for name in TASKS), ("vertical-jump", "mujoco")])
def test_a_used_environment_has_the_state_of_a_new_one_after_a_reset(name, solver):
    task = hardest(pushed(make_task(name)))
    used, new = (Env(task, N, seed=3, device="cpu", solver=solver) for _ in range(2))
    used.reset()
    for action in random_actions(N, 25):
        used.step(action)
    used.reset(seed=3)
    new.reset()
    assert not differences(used, new)
    for action in random_actions(N, 5):
        used.step(action)
    for env in (used, new):
        env.metrics()
        env.episodes.step_count.fill_(100)
        env.evaluation_reset([0.0, 0.0, 0.7] + [1.0] * (len(task.command.labels) - 3))
    assert not differences(used, new)


def test_the_push_of_an_earlier_episode_is_not_observed_after_a_reset():
    env = make_env(N, task=pushed(make_task("velocity-flat")), randomize=True)
    env.step(torch.zeros(N, 12))
    assert np.abs(env.robot.body_f.numpy()).max() > 0.1
    env.reset(worlds=[1])
    moved = np.abs(env.robot.body_f.numpy().reshape(N, -1)).max(axis=1) > 0.1
    assert moved.tolist() == [True, False, True, True]


def test_motors_hold_the_present_angles_until_the_first_action_arrives():
    """With a latency of 16 ms and an action of 0, motors pull with kp times the sensor error unless targets have it.

    The robot is weightless and at rest in the default pose.
    """
    task = make_task("vertical-jump")
    ranges = dataclasses.replace(task.randomization.off(), joint_offset=(2.0, 2.0), latency=(16.0, 16.0))
    task = dataclasses.replace(resetting(task, only("default")), randomization=ranges, gravity=0.0)
    env = make_env(N, task=task, randomize=True)
    offset = env.sim.motors.offset.numpy()
    np.testing.assert_allclose(offset, np.radians(2.0), rtol=1e-5)
    held = env.delays.target_history.numpy() - env.sim.motors.offset.numpy()
    angles = env.sim.joint_q()[:, [7 + 5 * leg + j for leg in range(4) for j in (0, 1, 3)]]
    np.testing.assert_allclose(held, np.broadcast_to(angles.T, held.shape), atol=1e-6)
    env.sim.advance(1, env.delays.current_target)
    assert np.abs(env.robot.torque.numpy()).max() < 1e-3


def reset_by(env, lanes):
    """Return coordinates, rates and states of the worlds after a reset with `lanes` threads per world."""
    skill = env.skills[0]
    env.sim.state.joint_q.assign(np.tile(env.sim.model.joint_q.numpy()[:43], LANE_WORLDS))
    skill.states.zero_()
    inputs = [skill.index, lanes, env._all, env._scene, env._settings, skill.settings, skill.levels, env.episodes,
              skill.states, env.robot]  # fmt: skip
    wp.launch(skill.kernels["reset"], (LANE_WORLDS, lanes), inputs, device="cpu", block_dim=max(lanes, 1))
    return env.sim.joint_q(), env.sim.joint_qd(), skill.states.numpy().copy()


@pytest.mark.parametrize("name", ["velocity-rough", "horizontal-jump", "attitude"])
def test_several_threads_per_world_sample_the_same_starts_as_one(name, monkeypatch):
    env = Env(hardest(make_task(name)), LANE_WORLDS, seed=3, device="cpu", randomize=False, noise=False)
    env.reset()
    alone = reset_by(env, 1)
    monkeypatch.setattr(wp.config, "enable_cpu_blocks", True)
    shared = reset_by(env, LANES)
    for found, expected in zip(shared[:2], alone[:2], strict=True):
        np.testing.assert_array_equal(found, expected)
    for field in shared[2].dtype.names:
        np.testing.assert_array_equal(shared[2][field], alone[2][field], err_msg=field)
    default = env.sim.model.joint_q.numpy()[7:43]
    assert (alone[0][:, 7:] != default).any(axis=1).sum() > LANE_WORLDS // 2  # sampled, not the default pose
