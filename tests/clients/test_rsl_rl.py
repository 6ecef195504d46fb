"""rsl-rl: random network distillation, W&B, and its checkpoints as policies of this project."""

import json
import re

import numpy as np
import pytest
import torch
from rsl_rl.runners import OnPolicyRunner

from jumper_warp.cli import evaluate, export, play
from jumper_warp.envs.env import Env
from jumper_warp.envs.rsl_rl import RslRlVecEnv
from jumper_warp.policies.policy import Policy
from jumper_warp.registry import make_task
from jumper_warp.rl.checkpoint import CheckpointError
from jumper_warp.rl.rsl_rl import rsl_rl_config
from toy_task import SMALL

N = 8


def adapter(task="vertical-jump"):
    env = RslRlVecEnv(Env(make_task(task), N, device="cpu", seed=3))
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
    path.with_name("config.json").write_text("{")
    with pytest.raises(CheckpointError, match=r"config\.json: not JSON"):
        Policy.load(path)
    path.with_name("config.json").write_text("{}")
    torch.save([1], path)
    with pytest.raises(CheckpointError, match=r"model_7\.pt: not a training checkpoint"):
        Policy.load(path)
