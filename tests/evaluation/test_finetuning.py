"""Fine-tuning: misses as an evaluation measures them, made smaller by gradients, and the command around it."""

import json

import numpy as np
import pytest
import torch

from jumper_warp.cli.main import main
from jumper_warp.evaluation.finetuning import FinetuneCfg, finetune, make_groups, with_aim
from jumper_warp.evaluation.jump_misses import follow
from jumper_warp.policies.policy import Policy
from jumper_warp.policies.runs import open_policy
from jumper_warp.trajectory.gauss_newton import Network
from jumper_warp.utils.errors import InputError

FEW = {"num_goals": 4, "num_delayed": 0, "num_randomized": 0, "height_range": (0.8, 1.05)}
FEW |= {"iterations": 1, "device": "cpu"}


@pytest.fixture(scope="module")
def tuned():
    """A policy that aims 8 mm too high, fine-tuned by one step, and what was done."""
    return finetune(aiming_high(), FinetuneCfg(**FEW), say=lambda line: None)


def aiming_high():
    """Return the shipped policy with goals that look 8 mm higher than they are."""
    policy = open_policy("vertical_jump")
    tensors = policy.tensors()
    mean = tensors["normaliser.mean"].clone()
    mean[policy.interface.observation_names.index("wanted_height")] -= 0.008
    return Policy(policy.layers, mean, tensors["normaliser.std"], policy.interface, policy.config)


def test_misses_are_those_of_the_policy_in_its_environment_and_gradients_change_no_bit():
    policy = open_policy("vertical_jump")
    (group,) = make_groups(policy, FinetuneCfg(**FEW))
    network = Network(policy)
    found, plain = follow(group, network, derivatives=True), follow(group, network, derivatives=False)
    assert torch.equal(found.value, plain.value)
    assert found.rows.shape == (4, len(network.weights)) and found.valid.all()
    group.begin()
    for _ in range(120):
        group.env.step(policy.act(group.env.obs))
    misses = group.env.task_arrays()["max_height"] - np.linspace(0.8, 1.05, 4)
    np.testing.assert_allclose(found.value.numpy(), misses, rtol=0.0, atol=1.0e-4)


def test_one_step_halves_the_misses_of_a_policy_that_aims_high(tuned):
    _, record = tuned
    before, after = (step["mean_abs_miss_m"]["nominal"] for step in record["steps"])
    assert before > 0.003
    assert after < 0.5 * before
    assert 0.0 < record["steps"][1]["action_change"] < 0.01


def test_the_same_seed_gives_the_same_bits(tuned):
    again, _ = finetune(aiming_high(), FinetuneCfg(**FEW), say=lambda line: None)
    for name, tensor in tuned[0].tensors().items():
        assert torch.equal(tensor, again.tensors()[name]), name


def test_command_writes_a_policy_that_can_be_opened(tmp_path, capsys):
    out = tmp_path / "tuned"
    flags = "--num-goals 2 --num-delayed 0 --num-randomized 0 --iterations 1 --device cpu".split()
    main(["finetune", "vertical_jump", *flags, "--out", str(out)])
    assert capsys.readouterr().out.splitlines()[-1] == str(out)
    policy = open_policy(out)
    assert not torch.equal(policy.layers[0][0], open_policy("vertical_jump").layers[0][0])
    assert policy.config["finetuned"]["settings"]["num_goals"] == 2
    assert len(json.loads((out / "finetuning.json").read_text())["steps"]) == 2
    with pytest.raises(SystemExit) as end:
        main(["finetune", "vertical_jump", "--out", str(out)])
    assert end.value.code == 2
    assert capsys.readouterr().err == f"jumper: {out} exists\n"


def test_misses_on_mars_are_those_of_robots_at_rest():
    policy = open_policy("mars_horizontal_jump")
    (group,) = make_groups(policy, FinetuneCfg(**FEW | {"distance_range": (1.0, 4.0)}))
    assert not group.to_height
    found = follow(group, Network(policy), derivatives=False)
    arrays = group.env.task_arrays()
    assert found.valid.all() and (arrays["phase_steps"] >= 60).all()  # a second after touchdown
    assert found.value.abs().max() < 0.05


def test_a_policy_sees_its_goals_shifted():
    policy, obs = open_policy("horizontal_jump"), 0.3 * torch.randn((5, 147), generator=torch.manual_seed(3))
    moved = obs.clone()
    moved[:, policy.interface.observation_names.index("goal_x")] += 0.02
    torch.testing.assert_close(with_aim(policy, 0.02).act(obs), policy.act(moved), rtol=0.0, atol=1.0e-5)
    assert (policy.act(moved) - policy.act(obs)).abs().max() > 1.0e-3


def test_aim_brings_a_policy_that_jumps_too_far_back_to_its_goals():
    """A policy with its goals 40 mm farther away than in training ends nearer to them than it did then."""
    policy = open_policy("slippery_jump")  # no aim was taken
    cfg = FinetuneCfg(**FEW | {"num_goals": 8, "iterations": 0})
    own = follow(make_groups(policy, cfg)[0], Network(policy), derivatives=False).value
    aimed, record = finetune(with_aim(policy, 0.04), cfg, say=lambda line: None)
    first, *_, last = record["aims"]
    assert first["ahead"]["nominal"] > 0.025 and abs(last["ahead"]["nominal"]) < 0.005
    assert last["mean_abs_miss_m"]["nominal"] < float(own.abs().mean()) and len(record["steps"]) == 1
    for mine, theirs in zip(aimed.layers, policy.layers, strict=True):
        assert torch.equal(mine[0], theirs[0]) and torch.equal(mine[1], theirs[1])
    assert not torch.equal(aimed.mean, policy.mean)


@pytest.mark.parametrize(
    "change",
    [{"num_goals": 1}, {"num_delayed": -1}, {"iterations": -1}, {"height_range": (0.9, 0.5)}, {"action_std": 0.0}],
)
def test_impossible_settings_are_refused(change):
    with pytest.raises(InputError):
        FinetuneCfg(**(FEW | change))


def test_policies_that_do_not_jump_are_refused():
    with pytest.raises(InputError, match="not for velocity-flat"):
        make_groups(open_policy("walking_flat"), FinetuneCfg(**FEW))


def test_no_step_is_refused_where_there_is_no_aim():
    with pytest.raises(InputError, match="needs an iteration"):
        finetune(open_policy("vertical_jump"), FinetuneCfg(**FEW | {"iterations": 0}))
