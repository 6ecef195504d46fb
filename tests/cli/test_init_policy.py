"""`jumper train --init-policy` initialises the actor of a new training from a policy."""

import json

import pytest
import torch

from jumper_warp.cli import main as cli
from jumper_warp.policies.policy import Policy
from jumper_warp.rl.checkpoint import load_checkpoint

TRAIN = "train horizontal-jump-mars --num-envs 4 --max-iterations 1 --device cpu --no-tensorboard".split()
TRAIN += ["--ppo.num-steps", "2", "--ppo.minibatches", "1", "--ppo.epochs", "1", "--ppo.init-std", "0.3"]
TRAIN += [part for name in ("lr", "min-lr", "max-lr") for part in (f"--ppo.{name}", "1e-9")]


@pytest.fixture(scope="module")
def begun(tmp_path_factory):
    """Folder of a training that started from horizontal_jump: one iteration with a learning rate of 1e-9."""
    root = tmp_path_factory.mktemp("logs")
    cli.main([*TRAIN, "--init-policy", "horizontal_jump", "--log-root", str(root)])
    (folder,) = (root / "horizontal-jump-mars").iterdir()
    return folder


def test_training_starts_with_the_weights_of_the_policy(begun):
    policy, trained = Policy.load("horizontal_jump"), Policy.load(begun)
    for (weight, bias), (same_weight, same_bias) in zip(policy.layers, trained.layers, strict=True):
        torch.testing.assert_close(same_weight, weight, atol=1e-6, rtol=0.0)
        torch.testing.assert_close(same_bias, bias, atol=1e-6, rtol=0.0)
    drift = (trained.mean - policy.mean).abs() / policy.std
    assert 0.0 < drift.max() < 0.2  # [standard deviations]
    assert trained.config["train"]["init_policy"] == "horizontal_jump"
    assert trained.config["train"]["ppo"]["init_std"] == 0.3
    log_std = load_checkpoint(begun / "checkpoints" / "iteration_000001.pt")["ppo"]["model"]["log_std"]
    torch.testing.assert_close(log_std.exp(), torch.full((12,), 0.3), atol=1e-6, rtol=0.0)


def test_latest_or_new_resumes_the_run_that_it_started(tmp_path, capsys):
    outputs = []
    for iterations in ("1", "2"):
        flags = ["--init-policy", "horizontal_jump", "--resume", "latest-or-new", "--max-iterations", iterations]
        cli.main([*TRAIN, *flags, "--log-root", str(tmp_path)])
        outputs.append(capsys.readouterr().err)
    (folder,) = (tmp_path / "horizontal-jump-mars").iterdir()
    assert "starts from horizontal_jump" in outputs[0] and "resumed" not in outputs[0]
    assert f"resumed {folder / 'checkpoints' / 'iteration_000001.pt'}" in outputs[1] and "starts from" not in outputs[1]
    config = json.loads((folder / "config.json").read_text())["train"]
    assert (config["max_iterations"], config["init_policy"]) == (2, "horizontal_jump")
    assert (folder / "checkpoints" / "iteration_000002.pt").is_file()
