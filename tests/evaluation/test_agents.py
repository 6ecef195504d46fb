import json

import numpy as np
import pytest

from jumper_warp.cli.main import main
from jumper_warp.envs.env import Env
from jumper_warp.evaluation.agents import AgentLog, actor
from jumper_warp.evaluation.log import run_evaluation
from jumper_warp.registry import make_task

COLUMNS = [7 + 5 * leg + joint for leg in range(4) for joint in (0, 1, 3)]


@pytest.fixture(scope="module")
def env():
    return Env(make_task("vertical-jump"), 32, seed=3, device="cpu", randomize=False, noise=False)


def test_hold_commands_the_motor_angles_in_which_each_episode_began(env):
    env.reset()
    act = actor("hold", env, seed=0)
    for _ in range(40):
        begun = env.episodes.done.numpy() != 0.0
        angles = env.sim.joint_q()[:, COLUMNS]
        env.step(act(env.obs))
        target = env.robot.target.numpy().T
        np.testing.assert_allclose(target[begun], angles[begun], atol=0.02)  # [rad] no start angle is out of range
    assert begun.shape == (32,)


def test_zero_commands_the_default_pose_and_random_the_whole_range(env):
    env.reset()
    assert not actor("zero", env, seed=0)(env.obs).any()
    act = actor("random", env, seed=0)
    actions = np.concatenate([act(env.obs).numpy() for _ in range(20)])
    assert actions.min() < -0.99
    assert actions.max() > 0.99


def test_the_log_counts_every_ended_episode_and_the_steps_of_each_reward(env):
    log = AgentLog(env.task, env.num_envs, seconds=1.5)
    ended = []
    run_evaluation(
        actor("random", env, seed=1),
        env,
        log,
        on_step=lambda: ended.append(int((env.episodes.done.numpy() != 0).sum())),
    )
    assert log.num_ended == sum(ended) > 10
    assert sum(log.endings.values()) == pytest.approx(1.0)
    assert set(log.rewards) == set(env.reward_terms)
    np.testing.assert_array_equal(log.rewards["action_rate"][-1], env.reward_terms["action_rate"].numpy())


def test_the_command_writes_statistics_and_a_recording(tmp_path, capsys):
    flags = ["--num-envs", "8", "--seconds", "0.1", "--check-gradients", "--device", "cpu", "--out", str(tmp_path)]
    main(["play", "vertical-jump", "--agent", "zero", *flags])
    assert "jump_height" in capsys.readouterr().out
    metrics = json.loads((tmp_path / "metrics.json").read_text())["metrics"]
    assert metrics["reward_action_rate_nonzero_rate"]["value"] == 0.0
    assert (tmp_path / "agent.rrd").exists()
