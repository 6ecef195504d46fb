"""rsl-rl: random network distillation, W&B, and its checkpoints as policies of this project."""

import dataclasses
import json
import re

import numpy as np
import pytest
import torch
from rsl_rl.runners import OnPolicyRunner
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from jumper_warp.cli import evaluate, export, play
from jumper_warp.envs.env import Env
from jumper_warp.envs.rsl_rl import RslRlVecEnv
from jumper_warp.policies.policy import Policy
from jumper_warp.registry import make_task
from jumper_warp.rl.checkpoint import CheckpointError
from jumper_warp.rl.learner import STATISTICS
from jumper_warp.rl.rsl_rl import rsl_rl_config
from jumper_warp.rl.training_run import LEARNING, PERF
from toy_task import SMALL

N = 16
SHORT = make_task("vertical-jump").with_terms("terminations", too_long={"steps": 12.0}, tilted={"angle": 0.15})
"""Task whose episodes end by time and by failure within a few steps."""


def adapter(task=None, **arguments):
    env = RslRlVecEnv(Env(task or make_task("vertical-jump"), N, device="cpu", seed=3), **arguments)
    env.reset()
    return env


def settings(**algorithm):
    """Return rsl-rl's settings of a short training, with further settings of its algorithm."""
    config = rsl_rl_config(SMALL, save_interval=1, seed=0)
    config["obs_groups"]["rnd_state"] = ["actor"]
    config["algorithm"] |= algorithm
    return config


@pytest.fixture(scope="module")
def trained(tmp_path_factory, one_thread):
    """A log folder of rsl-rl's own runner, and the runner."""
    folder, env = tmp_path_factory.mktemp("rsl_rl"), adapter()
    torch.manual_seed(0)
    runner = OnPolicyRunner(env, settings(), log_dir=str(folder), device="cpu")
    runner.learn(2)
    env.write_config(folder)
    return folder, runner


def test_random_network_distillation_trains(one_thread):
    rnd = {"rnd_cfg": {"weight": 2.0, "num_outputs": 4, "predictor_hidden_dims": [8], "target_hidden_dims": [8]}}
    runner = OnPolicyRunner(adapter(), settings(**rnd), log_dir=None, device="cpu")
    assert runner.alg.rnd.initial_weight == pytest.approx(2.0 / 60.0)  # weight times the policy step [s]
    runner.learn(1)
    assert (runner.alg.intrinsic_rewards > 0.0).all()


def test_policy_of_a_checkpoint_acts_as_rsl_rls(trained):
    folder, runner = trained
    obs = torch.from_numpy(np.random.default_rng(0).normal(0.0, 3.0, (64, runner.env.env.num_obs))).float()
    policy, actor = Policy.load(folder / "model_1.pt"), runner.get_inference_policy()
    expected = actor({"actor": obs}).clamp(-1.0, 1.0)
    torch.testing.assert_close(policy.act(obs), expected, atol=2.0e-6, rtol=0.0)
    assert policy.act(obs).std() > 0.1 and (actor.obs_normalizer.std < 0.1).any()
    assert policy.config["iteration"] == 1


def test_folder_means_its_newest_checkpoint(trained):
    folder, _ = trained
    newest, first = Policy.load(folder), Policy.load(folder / "model_0.pt")
    assert (newest.config["iteration"], first.config["iteration"]) == (1, 0)
    assert not torch.equal(newest.layers[0][0], first.layers[0][0])


def test_checkpoint_is_exported_evaluated_and_played(trained, tmp_path):
    run = trained[0]
    for source in (run, run / "model_1.pt"):
        assert export.export(export.ExportCfg((str(source),), overwrite=True)) == run / "policy"
    exported = Policy.load(run / "policy")
    obs = torch.randn(4, len(exported.mean))
    assert torch.equal(exported.act(obs), Policy.load(run / "model_1.pt").act(obs))
    evaluate.run([str(run), "--num-jumps", "2", "--device", "cpu", "--out", str(tmp_path / "metrics")], [])
    assert json.loads((tmp_path / "metrics" / "metrics.json").read_text())
    play.run([str(run / "model_1.pt"), "--device", "cpu", "--out", str(tmp_path / "film")], [])
    assert any((tmp_path / "film").glob("*.rrd"))


def test_checkpoint_without_the_environments_configuration_is_refused(trained, tmp_path):
    path = tmp_path / "model_7.pt"
    path.write_bytes((trained[0] / "model_1.pt").read_bytes())
    with pytest.raises(CheckpointError, match=re.escape(f"{path}: needs config.json beside it")):
        Policy.load(path)
    path.with_name("config.json").write_text("{}")
    torch.save([1], path)
    with pytest.raises(CheckpointError, match=r"model_7\.pt: not a training checkpoint"):
        Policy.load(path)


def test_value_bootstraps_time_outs_but_not_failures(one_thread):
    torch.manual_seed(0)
    env = adapter(SHORT)
    obs, _ = env.reset()
    config = rsl_rl_config(dataclasses.replace(SMALL, gamma=0.9), 100, 0)
    algorithm = OnPolicyRunner(env, config, log_dir=None, device="cpu").alg
    rewards, dones, time_outs = [], [], []
    with torch.inference_mode():
        for _ in range(SMALL.num_steps):
            obs, reward, done, extras = env.step(algorithm.act(obs))
            rewards.append(reward.clone())
            dones.append(done)
            time_outs.append(extras["time_outs"])
            algorithm.process_env_step(obs, reward, done, extras)
    reward, done, time_out = torch.stack(rewards), torch.stack(dones), torch.stack(time_outs)
    stored, value = algorithm.storage.rewards.squeeze(-1), algorithm.storage.values.squeeze(-1)
    torch.testing.assert_close(stored, reward + 0.9 * time_out * value)
    assert time_out.any() and (done.bool() & ~time_out.bool()).any()
    assert (stored - reward)[time_out.bool()].abs().min() > 1.0e-4


def test_log_has_the_keys_of_this_packages_trainer(tmp_path, one_thread):
    env = adapter(SHORT, metrics_every=SMALL.num_steps)
    OnPolicyRunner(env, rsl_rl_config(SMALL, 1, 0), log_dir=str(tmp_path), device="cpu").learn(2)
    assert (tmp_path / "model_1.pt").exists()
    events = EventAccumulator(str(tmp_path))
    events.Reload()
    assert [event.step for event in events.Scalars("Episode_Termination/too_long")] == [0, 1]
    theirs = {name for name in events.Tags()["scalars"] if not name.endswith("/time")}
    metrics = env.env.metrics().keys()
    assert metrics | {"Train/mean_reward", "Train/mean_episode_length"} <= theirs
    assert theirs - metrics <= {*PERF, *LEARNING, *(f"Loss/{name}" for name in STATISTICS)}
