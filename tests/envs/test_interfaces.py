"""Inputs of an environment: actions, commands, worlds, devices and settings, and one-line refusals of invalid ones."""

import math

import numpy as np
import pytest
import torch

from jump_helpers import edit_episodes, make_env, only, random_actions
from jumper_warp.envs.env import Env
from jumper_warp.evaluation.jumps import jump_commands
from jumper_warp.kernels.jump.state import LANDED, STANCE
from jumper_warp.registry import make_task

N = 8
TASK = make_task("vertical-jump")
REST = torch.zeros((N, 12))
NAN = math.nan


@pytest.fixture(scope="module")
def env():
    """Return N nominal worlds without noise that start in the default pose."""
    return make_env(N, reset=only("default"))


def assert_refused(env, message, call, *arguments):
    """Assert that a call raises a one-line error that matches, and does not change the environment's state."""
    before = env.state_dict()
    with pytest.raises(ValueError, match=message) as caught:
        call(*arguments)
    assert "\n" not in str(caught.value)
    after = env.state_dict()
    assert all(torch.equal(value, after[name]) for name, value in before.items() if value.dtype.is_floating_point)


# ---------------------------------------------------------------- actions


@pytest.mark.parametrize(
    ("action", "message"),
    [
        (torch.zeros(12), r"shape \(8, 12\), got \(12,\)"),
        (torch.zeros((12, N)), r"shape \(8, 12\), got \(12, 8\)"),
        (torch.zeros((N, 12), dtype=torch.int64), "floating-point numbers, got torch.int64"),
        (torch.zeros((N, 12), device="meta"), "on cpu, got meta"),
        (np.zeros((N, 12), dtype=np.float32), "torch tensor, got ndarray"),
    ],
    ids=lambda value: value[:40] if isinstance(value, str) else "",
)
def test_refuses_invalid_actions(env, action, message):
    assert_refused(env, "an action must .*" + message, env.step, action)


@pytest.mark.parametrize("kind", [torch.float64, torch.float16])
def test_accepts_actions_of_any_precision(kind):
    one, other = (make_env(N, reset=only("default")) for _ in range(2))
    action = torch.full((N, 12), 0.25)
    one.step(action)
    other.step(action.to(kind))
    assert torch.equal(one.obs, other.obs)


def test_actions_with_gradient_give_results_without(env):
    action = torch.zeros((N, 12), requires_grad=True)
    for _ in range(2):
        step = env.step(action * 2.0)
    assert not (step.reward.requires_grad or env.obs.requires_grad or env.action.requires_grad)
    assert all(not obs.requires_grad for obs in step.obs.values())


def test_a_step_does_not_change_the_action(env):
    action = 3.0 * random_actions(N, 1)[0]
    copy = action.clone()
    env.step(action)
    assert torch.equal(action, copy)


# ---------------------------------------------------------------- results of a step


def test_step_results_are_views_of_the_environments_tensors():
    """They are overwritten in place and agree with each other."""
    env = make_env(N, noise=True, randomize=True, seed=3)
    obs, extras = env.reset()
    assert obs["actor"] is env.obs and obs["critic"] is env.critic_obs and extras == {}
    previous, ends = None, torch.zeros(2)
    for action in random_actions(N, 200):
        step = env.step(action)
        assert previous is None or all(a is b for a, b in zip(step, previous, strict=True))
        previous = step
        assert step.obs["actor"] is env.obs and step.extras["final_obs"]["critic"] is env.final_critic_obs
        assert step.reward is env.reward and step.extras["time_outs"] is env.timeout
        assert step.terminated.dtype == step.truncated.dtype == torch.bool
        assert torch.equal(step.truncated, env.timeout == 1.0)
        assert torch.equal(step.terminated, (env.done == 1.0) & (env.timeout == 0.0))
        ends += torch.stack([step.terminated.sum(), step.truncated.sum()])
        edit_episodes(env, 0, phase=LANDED, phase_steps=59)
    assert (ends > 5).all()


def test_reward_terms_add_up_to_the_reward():
    env = make_env(N)
    terms = env.reward_terms
    for action in random_actions(N, 5):
        reward = env.step(action).reward
    assert list(terms) == [term.name for term in env.task.rewards] and terms is env.reward_terms
    total = torch.stack(list(terms.values())).sum(dim=0).clamp(min=0.0)
    torch.testing.assert_close(reward, total)
    assert any(value.any() for value in terms.values())


# ---------------------------------------------------------------- commands

WRONG_COMMANDS = [
    (np.zeros((3, 4)), r"x \[m\], y \[m\], height \[m\], .*, 8 rows or one for all, got shape \(3, 4\)"),
    (np.tile([0.0, 0.0, -5.0], (N, 1)), r"height \[m\] must be at least 0, got -5"),
    (np.tile([0.0, 0.0, 0.9, 2.5], (N, 1)), "policy step of the command .* must be"),
    (np.full((N, 3), NAN), "commands must be finite"),
    (["0", "0", "0.7"], "commands must be an array of numbers"),
]
WRONG_RESETS = [
    ({"worlds": np.zeros(3, dtype=bool)}, r"worlds must be bool of shape \(8,\), got bool of shape \(3,\)"),
    ({"worlds": np.zeros(N)}, "got float64"),
    ({"headings": np.zeros(3)}, r"headings must have shape \(8,\), got \(3,\)"),
    ({"headings": NAN}, "headings must be finite"),
    ({"headings": 1.0j}, "headings must be an array"),
]


@pytest.mark.parametrize(("commands", "message"), WRONG_COMMANDS)
def test_refuses_invalid_commands(env, commands, message):
    assert_refused(env, message, env.evaluation_reset, commands)
    assert_refused(env, message, env.command, commands)


@pytest.mark.parametrize(("arguments", "message"), WRONG_RESETS)
def test_refuses_invalid_worlds_and_headings(env, arguments, message):
    assert_refused(env, message, lambda: env.evaluation_reset(np.zeros((N, 3)), **arguments))
    if "worlds" in arguments:
        assert_refused(env, message, env.command, np.zeros((N, 3)), arguments["worlds"])
        assert_refused(env, message, env.request, 0, arguments["worlds"])


@pytest.mark.parametrize("kind", [np.asarray, torch.as_tensor, list])
def test_accepts_commands_as_array_tensor_or_list(kind):
    env = make_env(N, reset=only("default"))
    heights, headings = np.linspace(0.5, 0.9, N), np.linspace(-1.0, 1.0, N)
    chosen = np.arange(N) % 2 == 0
    commands = np.stack([np.zeros(N), np.zeros(N), heights, np.arange(N)], axis=1)
    env.evaluation_reset(kind(commands), kind(headings), kind(chosen))
    found = env.task_arrays()
    np.testing.assert_allclose(found["goal"][chosen, 2], heights[chosen], rtol=1e-6)
    np.testing.assert_allclose(found["heading"][chosen], headings[chosen], rtol=1e-6)
    np.testing.assert_array_equal(found["command_step"][chosen], np.arange(N)[chosen])
    assert (found["goal"][~chosen, 2] != heights[~chosen]).all()


def test_one_command_applies_to_all_worlds(env):
    env.evaluation_reset([0.0, 0.0, 0.7])
    np.testing.assert_allclose(env.task_arrays()["goal"], np.tile([0.0, 0.0, 0.7], (N, 1)), rtol=1e-6)


def test_values_of_unselected_worlds_may_be_out_of_range(env):
    commands = np.tile([0.0, 0.0, 0.7], (N, 1))
    commands[0, 2] = -1.0
    env.evaluation_reset(commands, worlds=np.arange(N) > 0)


def test_attitude_commands_are_normalised_quaternions():
    env = Env(make_task("attitude"), 2, randomize=False, noise=False)
    env.evaluation_reset([0.0, 0.0, 0.0, 1.0])
    env.command([0.0, 0.0, 3.0, 3.0])
    np.testing.assert_allclose(env.task_arrays()["goal"], [[0.0, 0.0, 0.5**0.5, 0.5**0.5]] * 2, atol=1e-6)
    assert_refused(env, "commands of attitude are quaternion x .*: not all may be 0", env.command, np.zeros((2, 4)))
    assert_refused(env, r"quaternion w \[1\], 2 rows or one for all, got shape \(2, 1\)", env.command, [[0.1], [0.1]])


# ---------------------------------------------------------------- evaluation and training


def test_an_evaluation_resets_no_ended_episode_until_reset():
    """After `reset`, a training continues: episodes are reset again, in the same captured graph."""
    env = make_env(N, reset=only("default"))
    for begin, ends in ((env.reset, True), (None, False), (env.reset, True), (None, False)):
        if begin is None:
            env.evaluation_reset(jump_commands(np.tile([0.0, 0.0, 0.7], (N, 1)), 10.0, env.step_dt))
        else:
            begin()
        edit_episodes(env, 0, phase=LANDED, phase_steps=59, command_step=1000)
        env.step(REST)
        found = env.task_arrays()
        assert env.done[0] == 1.0 and found["steps"][0] == (0 if ends else 1)
        assert found["phase"][0] == (STANCE if ends else LANDED)
    assert {ends for ends, *_ in env._graphs} == {True, False} and len(env._graphs) == 2


def test_without_auto_reset_only_reset_begins_episodes():
    env = make_env(N, reset=only("default"), auto_reset=False)
    edit_episodes(env, 0, phase=LANDED, phase_steps=59)
    for steps in (1, 2):
        step = env.step(REST)
        assert env.done[0] == 1.0 and env.task_arrays()["steps"][0] == steps
    env.reset(worlds=step.terminated | step.truncated)
    assert env.task_arrays()["steps"].tolist() == [0] + [2] * (N - 1)


def test_an_evaluation_can_start_in_some_worlds():
    env = make_env(N, reset=only("default"))
    for action in random_actions(N, 5):
        env.step(action)
    chosen = np.arange(N) < 3
    before, obs = env.sim.joint_q().copy(), env.obs.clone()
    env.evaluation_reset(np.tile([0.0, 0.0, 0.7], (N, 1)), worlds=chosen)
    np.testing.assert_array_equal(env.sim.joint_q()[~chosen], before[~chosen])
    assert torch.equal(env.obs[~chosen], obs[~chosen])
    steps = env.task_arrays()["steps"]
    assert not steps[chosen].any() and (steps[~chosen] == 5).all()
    standing = env.sim.model.joint_q.numpy().reshape(N, -1)
    np.testing.assert_array_equal(env.sim.joint_q()[chosen], standing[chosen])


# ---------------------------------------------------------------- construction


def test_the_first_step_needs_a_reset():
    env = Env(TASK, 2, device="cpu")
    with pytest.raises(RuntimeError, match="call reset before the first step"):
        env.step(torch.zeros((2, 12)))
    env.reset()
    env.step(torch.zeros((2, 12)))
    measured = Env(TASK, 2, device="cpu")
    measured.evaluation_reset(np.zeros((2, 3)))
    measured.step(torch.zeros((2, 12)))
    loaded = Env(TASK, 2, device="cpu")
    loaded.load_state_dict(env.state_dict())
    loaded.step(torch.zeros((2, 12)))


# ---------------------------------------------------------------- parameters of terms


def test_a_changed_parameter_of_a_term_acts_in_captured_steps():
    index, term = next((i, term) for i, term in enumerate(TASK.rewards) if term.name == "orientation")
    env = make_env(N, reset=only("default"))
    edit_episodes(env, command_step=1000)
    for _ in range(3):
        env.step(REST)
    before = env.skills[0].term_value.numpy().copy()
    env.set("rewards.orientation.weight", 2.0 * term.weight)
    env.step(REST)
    np.testing.assert_allclose(env.skills[0].term_value.numpy()[index], 2.0 * before[index], rtol=1e-3)
    env.skills[0].set("terminations", "low_base", height=10.0)
    env.step(REST)
    assert env.done.all() and [TASK.terminations[i].name for i in env.episodes.termination.numpy()] == ["low_base"] * N


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("rewards.orientation.weight", NAN, "'weight' must be a finite number within 1e\\+09, got nan"),
        ("rewards.orientation.depth", 1.0, "no number 'depth' of a rewards term 'orientation'"),
        ("weight", 1.0, "names are like rewards.jump_height.weight"),
    ],
)
def test_refuses_invalid_parameters_of_terms(env, name, value, message):
    before = env.skills[0].params.values.numpy().copy()
    with pytest.raises(ValueError, match=message):
        env.set(name, value)
    with pytest.raises(ValueError, match="skill must be an index below 1, got 1"):
        env.set("rewards.orientation.weight", 1.0, skill=1)
    np.testing.assert_array_equal(env.skills[0].params.values.numpy(), before)


# ---------------------------------------------------------------- reset of some worlds


@pytest.mark.parametrize("worlds", [[1, 5], torch.tensor([5, 1]), np.isin(np.arange(N), (1, 5))])
def test_reset_of_some_worlds_changes_no_other(worlds):
    env, chosen = make_env(N, noise=True, randomize=True, seed=3), np.isin(np.arange(N), (1, 5))
    env.reset()
    env.episodes.level.fill_(2)
    for action in 0.1 * random_actions(N, 4):
        env.step(action)
    before, motions, old_obs = env.task_arrays(), env.sim.joint_q().copy(), env.obs.clone()
    obs, extras = env.reset(worlds=worlds)
    found = env.task_arrays()
    assert obs["actor"] is env.obs and extras == {} and (found["level"] == 2).all()
    assert (found["steps"][chosen] == 0).all()
    changed = (env.sim.joint_q() != motions).any(axis=1)
    assert changed.tolist() == chosen.tolist() == (env.obs != old_obs).any(dim=1).tolist()
    assert all(np.array_equal(found[name][~chosen], before[name][~chosen], equal_nan=True) for name in before)
    env.step(REST)
    assert (env.task_arrays()["steps"][~chosen] == before["steps"][~chosen] + 1).all()
    states = env.sim.joint_q()[chosen]
    env.reset(worlds=worlds)
    assert (env.sim.joint_q()[chosen] != states).any(axis=1).all()  # sampled again


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"worlds": [0, 0]}, r"8 bools, or distinct indices below 8, got \[0, 0\]"),
        ({"worlds": [0], "seed": 1}, "a seed resets all worlds"),
    ],
)
def test_refuses_invalid_resets_of_some_worlds(env, arguments, message):
    assert_refused(env, message, lambda: env.reset(**arguments))
    with pytest.raises(RuntimeError, match="reset all worlds before"):
        Env(TASK, 1, device="cpu").reset(worlds=[0])
