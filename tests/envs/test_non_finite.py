"""Terms that are not finite: the environment records the first value of each, with the state of its world."""

import dataclasses
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import warp as wp

from jump_helpers import edit_coordinates, edit_episodes, make_env, only
from jumper_warp.envs.vec_env import RAW_LIMIT
from jumper_warp.evaluation.commands import DumpCfg, play_dump
from jumper_warp.kernels.mdp.view import RobotView
from jumper_warp.registry import make_task
from jumper_warp.robot.overlay import load_overlay
from jumper_warp.sim import simulation
from jumper_warp.tasks.terms import ObservationTerm, RewardTerm
from jumper_warp.utils.dumps import load_dump, write_dump
from jumper_warp.utils.errors import InputError
from velocity_helpers import edit

N = 48
LIMIT = 1.0  # [m] The faulty terms are not finite above this height of the base
REST = torch.zeros((N, 12))


@wp.func
def below(robot: RobotView, state: Any) -> float:
    """Return the square root of the distance below LIMIT, NaN above it."""
    return wp.sqrt(LIMIT - robot.pos[2])


@wp.func
def below_twice(robot: RobotView, state: Any) -> wp.vec2:
    """Return 1 and the square root of the distance below LIMIT, NaN above it."""
    return wp.vec2(1.0, wp.sqrt(LIMIT - robot.pos[2]))


def faulty_task():
    """Return a jump with a reward and an observation that are not finite above LIMIT."""
    task = make_task("vertical-jump")
    actor = (*task.observations.actor, ObservationTerm(below_twice, history=2))
    observations = dataclasses.replace(task.observations, actor=actor)
    return dataclasses.replace(task, rewards=(*task.rewards, RewardTerm(below, 2.0)), observations=observations)


@pytest.fixture(scope="module", params=[1, 2], ids=["one slice", "two slices"])
def env(request):
    """Return N nominal worlds, on one thread and on two, with faulty terms."""
    return make_env(N, task=faulty_task(), reset=only("default"), threads=request.param)


def lift(env, *worlds):
    """Lift the base of some worlds above LIMIT."""
    edit_episodes(env, command_step=1000)
    for world in worlds:
        edit_coordinates(env, world, q={2: 1.5 + 0.01 * world})


def test_first_value_of_each_term_is_reported_once_with_the_state_of_its_world(env):
    for _ in range(3):
        env.step(REST)
    assert env.non_finite() == []
    lift(env, 5, 40)
    action = torch.linspace(-1.0, 1.0, 12 * N).reshape(N, 12)
    env.step(action)
    found = {value.term: value for value in env.non_finite()}
    assert found.keys() == {"rewards.below", "observations.actor.below_twice"}
    for value in found.values():
        assert math.isnan(value.value) and (value.world, value.step) == (5, 4)
        arrays, height = value.arrays, env.sim.joint_q()[5, 2]
        assert arrays["joint_q"][2] == pytest.approx(height) and height > LIMIT
        np.testing.assert_array_equal(arrays["action"], action[5].numpy())
        assert arrays["joint_qd"].shape == (38,) and "state.command_step" in arrays
        rewards = dict(zip(value.names["rewards"], arrays["rewards"], strict=True))
        assert math.isnan(rewards["below"]) and math.isfinite(rewards[next(iter(rewards))])
    observed = found["observations.actor.below_twice"]
    components = dict(zip(observed.names["observations"], observed.arrays["observations"], strict=True))
    assert [name for name, value in components.items() if math.isnan(value)] == ["actor.below_twice_y"]
    env.step(REST)
    assert env.non_finite() == []  # each term once
    assert torch.isfinite(env.obs).all() and torch.isfinite(env.reward).all()


def test_state_and_action_that_are_not_finite_are_reported_but_fast_motion_is_not():
    env = make_env(N, task=make_task("vertical-jump"), reset=only("default"))
    edit_episodes(env, command_step=1000)
    edit_coordinates(env, 3, qd={2: 50.0})  # too fast, which ends the episode as `diverged`
    env.step(REST)
    assert env.done[3] == 1.0 and env.non_finite() == []
    action = REST.clone()
    action[4, 7] = math.inf
    env.step(action)
    (found,) = env.non_finite()
    assert (found.term, found.world) == ("terminations.diverged", 4)


def test_a_value_that_is_not_finite_counts_as_0_in_the_metrics(env):
    env.reset()
    env.metrics()
    lift(env, 5)
    env.step(REST)
    edit_episodes(env, steps=10**6)  # all episodes end as too long
    env.step(REST)
    assert env.done.all()
    metrics = env.metrics()
    mean_height = metrics["Episode_Reward/below"]  # of 47 worlds
    assert mean_height > 0.0
    assert {name for name, value in metrics.items() if not math.isfinite(value)} == {"Metrics/error_of_successes_m"}


def test_a_reward_of_weight_0_is_not_evaluated():
    task = make_task("vertical-jump")
    task = dataclasses.replace(task, rewards=(*task.rewards, RewardTerm(below, 0.0)))
    env = make_env(N, task=task, reset=only("default"))
    lift(env, 5)
    env.step(REST)
    assert env.non_finite() == []
    assert not env.reward_terms["below"].any()


def test_a_metric_of_the_state_counts_a_value_that_is_not_finite_as_0():
    env = make_env(N, task=make_task("attitude"))
    edit(env, sum_error=0.25, episodes=1.0)
    edit(env, 3, sum_error=math.nan)
    assert env.metrics()["Metrics/error_at_end_rad"] == pytest.approx(0.25 * (N - 1) / N)


def test_dump_is_read_and_played(tmp_path, capsys, monkeypatch):
    env = make_env(N, task=faulty_task(), reset=only("default"))
    lift(env, 7)
    env.step(REST)
    heavy = load_overlay(Path("heavy"))
    path, found = tmp_path / "non_finite" / "below.npz", env.non_finite()[0]
    write_dump(path, found, iteration=3, task="jump", config={"train": {"seed": 11}, "env": {"robot": heavy.to_json()}})
    read, header = load_dump(path)
    assert str(read) == str(found) and header["iteration"] == 3
    for name, values in found.arrays.items():
        np.testing.assert_array_equal(read.arrays[name], values)
    damaged = tmp_path / "damaged.npz"
    damaged.write_bytes(path.read_bytes()[:-100])
    with pytest.raises(InputError, match=r"damaged.npz"):
        load_dump(damaged)
    drawn = []
    kind = simulation.Simulation
    monkeypatch.setattr(simulation, "Simulation", lambda *a, **k: drawn.append(kind(*a, **k)) or drawn[0])
    recording = play_dump(DumpCfg(path, out=tmp_path / "film"))
    assert float(drawn[0].model.body_mass.numpy().sum()) == pytest.approx(40.0, abs=0.1)  # [kg] of `heavy`
    assert recording.is_file() and recording.with_suffix(".png").is_file()
    printed = capsys.readouterr().out
    assert f"jump, iteration 3, seed 11: {found}" in printed and "rewards that are not finite: below" in printed


def test_observations_are_finite_and_bounded_whatever_their_terms_return():
    task = make_task("vertical-jump")
    actor = (ObservationTerm(below_twice, scale=1.0e6, history=2), *task.observations.actor)
    critic = (ObservationTerm(below_twice, scale=1.0e6), *task.observations.critic)
    observations = dataclasses.replace(task.observations, actor=actor, critic=critic)
    env = make_env(N, task=dataclasses.replace(task, observations=observations), reset=only("default"))
    lift(env, 3)
    env.step(REST)
    for obs in (env.obs, env.critic_obs, env.final_obs, env.final_critic_obs):
        assert obs.isfinite().all() and obs.abs().max() == RAW_LIMIT
    assert env.obs[0, :2].tolist() == [RAW_LIMIT] * 2
