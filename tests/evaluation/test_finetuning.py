"""Fine-tuning: jump errors, their reduction by Gauss-Newton, and `jumper finetune`."""

import json
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from jumper_warp.cli.main import main
from jumper_warp.evaluation.conditions import Conditions, env_of_recipe
from jumper_warp.evaluation.finetuning import finetune, make_groups, mean_abs_errors, shift_goal_observation
from jumper_warp.evaluation.finetuning_cfg import FinetuneCfg
from jumper_warp.evaluation.jump_errors import JumpErrors, ballistic_landing, jump_errors
from jumper_warp.evaluation.jumps import JumpLog
from jumper_warp.policies.policy import Policy
from jumper_warp.robot.overlay import RobotOverlay
from jumper_warp.trajectory.gauss_newton import Network

FEW = {"num_goals": 4, "num_delayed": 0, "num_randomized": 0, "height_range": (1.2, 2.5)}
FEW |= {"iterations": 1, "device": "cpu"}


@pytest.fixture(scope="module")
def tuned():
    """Policy of `aiming_high` after one iteration of fine-tuning, and its record."""
    return finetune(aiming_high(), FinetuneCfg(**FEW), log=lambda line: None)


def aiming_high():
    """Return the shipped policy with an observation of the commanded height that is 20 mm too large."""
    policy = Policy.load("mars_vertical_jump")
    tensors = policy.tensors()
    mean = tensors["normaliser.mean"].clone()
    mean[policy.interface.observation_names.index("wanted_height")] -= 0.02
    return Policy(policy.layers, mean, tensors["normaliser.std"], policy.interface, policy.config)


def test_jump_errors_match_environment_with_and_without_derivatives():
    policy = Policy.load("mars_vertical_jump")
    (group,) = make_groups(policy.recipe(), FinetuneCfg(**FEW))
    network = Network(policy)
    errors, plain = jump_errors(group, network, derivatives=True), jump_errors(group, network, derivatives=False)
    assert torch.equal(errors.value, plain.value)
    assert errors.jacobian.shape == (4, len(network.weights)) and errors.valid.all()
    jumps = JumpLog(np.linspace(1.2, 2.5, 4), group.env.task.termination_names)
    group.begin()
    for _ in range(180):  # 3 s, until after the apex
        group.env.step(policy.act(group.env.obs))
        jumps.update(jumps.read_env(group.env), group.env.step_dt)
    misses = jumps.outcome.apex_error_m[:, 0]
    np.testing.assert_allclose(errors.value.numpy(), misses, rtol=0.0, atol=1.0e-4)


def test_errors_of_bases_that_rise_twice_are_those_of_the_evaluation():
    """Two of three bases rise again after their first apex, by up to 12 mm."""
    policy, count = Policy.load("mars_vertical_jump"), 64
    _, group = make_groups(policy.recipe(), FinetuneCfg(num_goals=2, num_delayed=0, num_randomized=count, device="cpu"))
    errors = jump_errors(group, Network(policy), derivatives=False)
    jumps = JumpLog(group.commands[:, 2], group.env.task.termination_names)
    group.begin()
    for _ in range(180):  # 3 s, until after the landing
        group.env.step(policy.act(group.env.obs))
        jumps.update(jumps.read_env(group.env), group.env.step_dt)
    landed = jumps.outcome.landed[:, 0]
    assert landed.sum() > 0.9 * count
    np.testing.assert_allclose(errors.value.numpy()[landed], jumps.outcome.apex_error_m[landed, 0], rtol=0.0, atol=1e-4)


def test_one_iteration_reduces_error_of_biased_policy_with_small_change_of_actions(tuned):
    _, record = tuned
    before, after = (step["mean_abs_miss_m"]["nominal"] for step in record["steps"])
    assert before > 0.003  # [m]
    assert after < 0.65 * before  # 0.57: after the iteration one base rises twice, and the second apex is higher
    assert 0.0 < record["steps"][1]["action_change"] < 0.01


def test_finetuning_to_another_robot_keeps_its_overlay(tmp_path):
    overlay = RobotOverlay({"base_mass": (7.43,), "kp": 12 * (0.88,), "kd": 12 * (1.15,)})
    overlay.save(tmp_path / "robot.json")
    policy, record = finetune(
        Policy.load("mars_vertical_jump"), FinetuneCfg(**FEW, robot=tmp_path / "robot.json"),
        log=lambda line: None,
    )  # fmt: skip
    assert policy.config["env"]["robot"] == overlay.to_json()
    before, after = (step["mean_abs_miss_m"]["nominal"] for step in record["steps"])
    assert after < 0.5 * before and before > 0.002  # [m]
    env = env_of_recipe(policy.recipe(), 4, Conditions(device="cpu"))
    assert env.sim.model.body_mass.numpy()[0] == pytest.approx(7.43)


def test_finetuning_is_bitwise_reproducible(tuned):
    again, _ = finetune(aiming_high(), FinetuneCfg(**FEW), log=lambda line: None)
    for name, tensor in tuned[0].tensors().items():
        assert torch.equal(tensor, again.tensors()[name]), name


def test_finetune_command_writes_a_loadable_policy_and_refuses_to_overwrite_it(tmp_path, capsys):
    out = tmp_path / "tuned"
    flags = "--num-goals 2 --num-delayed 0 --num-randomized 0 --iterations 1 --device cpu".split()
    main(["finetune", "mars_vertical_jump", *flags, "--out", str(out)])
    assert capsys.readouterr().out.splitlines()[-1] == str(out)
    policy = Policy.load(out)
    assert not torch.equal(policy.layers[0][0], Policy.load("mars_vertical_jump").layers[0][0])
    assert policy.config["finetuned"]["settings"]["num_goals"] == 2
    assert len(json.loads((out / "finetuning.json").read_text())["steps"]) == 2
    with pytest.raises(SystemExit) as end:
        main(["finetune", "mars_vertical_jump", "--out", str(out)])
    assert end.value.code == 2
    assert capsys.readouterr().err == f"jumper: {out} exists; overwrite replaces it\n"


def test_landing_errors_on_mars_are_measured_at_rest():
    policy = Policy.load("mars_horizontal_jump")
    (group,) = make_groups(policy.recipe(), FinetuneCfg(**FEW | {"distance_range": (1.0, 4.0)}))
    assert not group.to_height
    errors = jump_errors(group, Network(policy), derivatives=False)
    arrays = group.env.task_arrays()
    assert errors.valid.all() and (arrays["phase_steps"] >= 60).all()  # a second after touchdown
    assert errors.value.abs().max() < 0.05  # [m]


def test_ballistic_landing_is_where_a_projectile_on_mars_falls_to_0_3_m():
    policy, rng = Policy.load("mars_horizontal_jump"), np.random.default_rng(0)
    (group,) = make_groups(policy.recipe(), FinetuneCfg(**FEW | {"distance_range": (1.0, 4.0)}))
    pos, vel = rng.uniform(0.5, 1.5, (2, 4, 3))  # [m], [m/s]; without rotation, the com and the base move alike
    with group.gradients as gradients:
        state = gradients.state
    state.q[:3], state.qd[:3], state.qd[3:] = torch.as_tensor(pos.T), torch.as_tensor(vel.T), 0.0
    landing = ballistic_landing(gradients, [state], torch.zeros(4, dtype=torch.int64))
    time = [np.roots([-0.5 * 3.71, up, height - 0.3]).max() for up, height in zip(vel[:, 2], pos[:, 2], strict=True)]
    expected = pos + vel * np.array(time)[:, None]
    np.testing.assert_allclose(torch.stack(landing).numpy(), expected[:, :2].T, rtol=1e-5)


def test_the_miss_of_a_place_is_the_mean_distance_from_the_goal():
    places, heights = (SimpleNamespace(name=name, commands=np.zeros((3, 4))) for name in ("places", "heights"))
    value = torch.tensor([0.3, 0.0, 0.0, -0.4, 0.1, 0.0])  # [m] x, then y; the third jump is not valid
    landed = JumpErrors(value, torch.zeros(0), torch.tensor([True, True, False, True, True, True]))
    rose = JumpErrors(torch.tensor([0.1, -0.3, 0.0]), torch.zeros(0), torch.tensor([True, True, False]))
    expected = {"places": 0.3, "heights": 0.2}
    assert mean_abs_errors([places, heights], [landed, rose]) == pytest.approx(expected)


@pytest.mark.parametrize("seed", [0, 5])
def test_finetuning_and_evaluation_share_no_robot_and_no_delay(seed):
    policy = Policy.load("mars_vertical_jump")
    cfg = FinetuneCfg(**FEW | {"num_goals": 2, "num_randomized": 16, "seed": 0})
    tuned = make_groups(policy.recipe(), cfg)[-1].env
    reported = env_of_recipe(policy.recipe(), 16, Conditions(randomize=True, noise=True, seed=seed, device="cpu"))
    for env in (tuned, reported):
        env.evaluation_reset(np.tile([0.0, 0.0, 0.8], (16, 1)))
    masses = [env.parameters.body_mass.numpy().reshape(16, 1, -1) for env in (tuned, reported)]
    gains = [env.parameters.gain_ratio.numpy().swapaxes(0, 1).reshape(16, 1, -1) for env in (tuned, reported)]
    for drawn in (masses, gains):
        random = np.ptp(drawn[0], axis=0)[0] > 0.0
        assert random.sum() > 10
        assert not (drawn[0] == drawn[1].swapaxes(0, 1))[..., random].any()


def test_policy_with_shifted_goal_observation_acts_as_for_shifted_goal():
    policy, obs = Policy.load("horizontal_jump"), 0.3 * torch.randn((5, 147), generator=torch.manual_seed(3))
    moved = obs.clone()
    moved[:, policy.interface.observation_names.index("goal_x")] += 0.02
    torch.testing.assert_close(shift_goal_observation(policy, 0.02).act(obs), policy.act(moved), rtol=0.0, atol=1.0e-5)
    assert (policy.act(moved) - policy.act(obs)).abs().max() > 1.0e-3


def test_correct_aim_removes_constant_overshoot():
    """A policy that observes goals 60 mm too far misses a quarter as far, or less, after the correction alone."""
    policy, cfg = Policy.load("horizontal_jump"), FinetuneCfg(**FEW | {"num_goals": 16, "iterations": 0})
    aimed, record = finetune(shift_goal_observation(policy, 0.06), cfg, log=lambda line: None)
    first, *_, last = record["aims"]
    assert first["ahead"]["nominal"] > 0.025 and abs(last["ahead"]["nominal"]) < 0.005
    assert last["mean_abs_miss_m"]["nominal"] < 0.25 * first["mean_abs_miss_m"]["nominal"]
    assert len(record["steps"]) == 1
    for mine, theirs in zip(aimed.layers, policy.layers, strict=True):
        assert torch.equal(mine[0], theirs[0]) and torch.equal(mine[1], theirs[1])
    assert not torch.equal(aimed.mean, policy.mean)
