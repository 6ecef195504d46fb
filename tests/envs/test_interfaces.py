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


# ---------------------------------------------------------------- actions


def test_a_step_does_not_change_the_action(env):
    action = 3.0 * random_actions(N, 1)[0]
    copy = action.clone()
    env.step(action)
    assert torch.equal(action, copy)


# ---------------------------------------------------------------- results of a step


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


REFUSED = [
    (lambda env: env.step(torch.zeros((12, N))), r"shape \(8, 12\), got \(12, 8\)"),
    (lambda env: env.step(torch.zeros((N, 12), dtype=torch.int64)), "floating-point numbers, got torch.int64"),
    (lambda env: env.step(torch.zeros((N, 12), device="meta")), "on cpu, got meta"),
    (lambda env: env.evaluation_reset(np.zeros((3, 4))), r"8 rows or one for all, got shape \(3, 4\)"),
    (lambda env: env.command([0.0, 0.0, -5.0]), r"height \[m\] must be at least 0, got -5"),
    (lambda env: env.command([0.0, 0.0, 0.9, 2.5]), "policy step of the command .* must be"),
    (lambda env: env.command(np.full((N, 3), NAN)), "commands must be finite"),
    (lambda env: env.command(np.zeros((N, 3)), np.zeros(N)), "worlds must be bool .* got float64"),
    (
        lambda env: env.request(0, np.zeros(3, dtype=bool)),
        r"worlds must be bool of shape \(8,\), got bool of shape \(3,\)",
    ),
    (lambda env: env.evaluation_reset(np.zeros((N, 3)), headings=NAN), "headings must be finite"),
    (lambda env: env.reset(worlds=[0, 0]), r"8 bools, or distinct indices below 8, got \[0, 0\]"),
    (lambda env: env.reset(worlds=[0], seed=1), "a seed resets all worlds"),
    (lambda env: env.set("rewards.orientation.weight", NAN), "'weight' must be a finite number within"),
    (lambda env: env.set("rewards.orientation.depth", 1.0), "no number 'depth' of a rewards term 'orientation'"),
    (lambda env: env.set("terminations.too_long.steps", -1.0), "steps"),
]


@pytest.mark.parametrize(("call", "message"), REFUSED)
def test_a_refused_input_is_one_line_and_changes_no_state(env, call, message):
    before = env.state_dict()
    with pytest.raises(ValueError, match=message) as caught:
        call(env)
    assert "\n" not in str(caught.value)
    assert all(
        torch.equal(value, before[name]) for name, value in env.state_dict().items() if value.dtype.is_floating_point
    )


@pytest.mark.parametrize("kind", [np.asarray, torch.as_tensor, list])
def test_accepts_commands_as_array_tensor_or_list(env, kind):
    env.reset()
    heights, headings = np.linspace(0.5, 0.9, N), np.linspace(-1.0, 1.0, N)
    chosen = np.arange(N) % 2 == 0
    commands = np.stack([np.zeros(N), np.zeros(N), heights, np.arange(N)], axis=1)
    env.evaluation_reset(kind(commands), kind(headings), kind(chosen))
    found = env.task_arrays()
    np.testing.assert_allclose(found["goal"][chosen, 2], heights[chosen], rtol=1e-6)
    np.testing.assert_allclose(found["heading"][chosen], headings[chosen], rtol=1e-6)
    np.testing.assert_array_equal(found["command_step"][chosen], np.arange(N)[chosen])
    assert (found["goal"][~chosen, 2] != heights[~chosen]).all()


def test_values_of_unselected_worlds_may_be_out_of_range(env):
    commands = np.tile([0.0, 0.0, 0.7], (N, 1))
    commands[0, 2] = -1.0
    env.evaluation_reset(commands, worlds=np.arange(N) > 0)


def test_attitude_commands_are_normalised_quaternions():
    env = Env(make_task("attitude"), 2, randomize=False, noise=False)
    env.evaluation_reset([0.0, 0.0, 0.0, 1.0])
    env.command([0.0, 0.0, 3.0, 3.0])
    np.testing.assert_allclose(env.task_arrays()["goal"], [[0.0, 0.0, 0.5**0.5, 0.5**0.5]] * 2, atol=1e-6)


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
    env, measured, loaded = (Env(TASK, 2, device="cpu") for _ in range(3))
    with pytest.raises(RuntimeError, match="call reset before the first step"):
        env.step(REST[:2])
    with pytest.raises(RuntimeError, match="reset all worlds before"):
        env.reset(worlds=[0])
    env.reset()
    measured.evaluation_reset(np.zeros((2, 3)))
    loaded.load_state_dict(env.state_dict())
    for each in (env, measured, loaded):
        each.step(REST[:2])


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
