"""Durations of 2**31 policy steps or more, and infinite ones, mean never."""

import dataclasses
import math

import numpy as np
import pytest
import torch

from hold_height import hold_height
from jump_helpers import episodes_of, make_env
from jumper_warp import mdp
from jumper_warp.envs.env import Env
from jumper_warp.kernels.jump import terminations
from jumper_warp.registry import make_task
from jumper_warp.tasks.saving import task_from_json, task_to_json
from jumper_warp.tasks.terms import EventTerm, TerminationTerm
from jumper_warp.utils.errors import InputError

NEVER = [3.6e7, 1.0e9, math.inf]
N = 4


@pytest.mark.parametrize("seconds", NEVER)
def test_a_velocity_command_of_infinite_duration_stays(seconds):
    task = make_task("velocity-flat")
    level = dataclasses.replace(task.levels[0], resampling_time_range=(seconds, seconds), standing_probability=0.0)
    env = Env(dataclasses.replace(task, levels=(level,)), N, device="cpu", randomize=False, seed=1)
    env.reset()
    commands = env.task_arrays()["command"]
    for _ in range(3):
        env.step(torch.zeros(N, 12))
        assert not env.done.any()
    np.testing.assert_array_equal(env.task_arrays()["command"], commands)


@pytest.mark.parametrize("seconds", NEVER)
def test_an_interval_event_of_infinite_period_runs_at_resets_only(seconds):
    """The event scales torque limits by random factors."""
    weak = hold_height().events[0].replace(mode="interval", interval_range_s=(seconds, seconds))
    env = Env(dataclasses.replace(hold_height(), events=(weak,)), N, device="cpu", seed=1)
    env.reset()
    ratios = env.parameters.torque_ratio.numpy().copy()
    for _ in range(3):
        env.step(torch.zeros(N, 12))
    np.testing.assert_array_equal(env.parameters.torque_ratio.numpy(), ratios)
    assert len(np.unique(ratios)) == 12 * N


@pytest.mark.parametrize("step", [2.0**31, 3.0e9, math.inf])
def test_a_jump_commanded_at_an_infinite_step_is_never_commanded(step):
    env = make_env(N)
    env.evaluation_reset([0.0, 0.0, 0.9, step])
    assert (episodes_of(env)["command_step"] > 2**31 - 1000).all()
    assert not env.task_arrays()["idle_steps"].any()


@pytest.mark.parametrize("steps", [2.0**31, 3.0e9, math.inf])
def test_a_time_limit_of_infinite_steps_ends_no_episode(steps):
    env = make_env(N, task=make_task("vertical-jump").with_terms("terminations", too_long={"steps": 5.0}))
    env.set("terminations.too_long.steps", steps)
    env.set("terminations.no_jump.steps", steps)
    for _ in range(7):
        env.step(torch.zeros(N, 12))
        assert not env.done.any()
    saved = env.state_dict()
    env.set("terminations.too_long.steps", 5.0)
    env.load_state_dict(saved)
    env.step(torch.zeros(N, 12))
    assert not env.done.any()


@pytest.mark.parametrize("steps", [-1.0, math.nan, -math.inf])
def test_refuses_negative_and_undefined_durations(steps):
    with pytest.raises(InputError, match="idle_steps"):
        TerminationTerm(terminations.no_jump, steps=3.0, idle_steps=steps)
    with pytest.raises(InputError, match="interval_range_s"):
        EventTerm(mdp.events.joint_offset, mode="interval", interval_range_s=(1.0, steps), lower=0.0, upper=0.0)
    with pytest.raises(InputError, match="resampling_time_range"):
        dataclasses.replace(make_task("velocity-flat").levels[0], resampling_time_range=(1.0, steps))


def test_an_infinite_time_limit_is_saved_and_is_no_time_limit_of_the_metrics():
    task = make_task("vertical-jump").with_terms("terminations", too_long={"steps": math.inf})
    assert task_from_json(task_to_json(task)) == task
    assert task.max_episode_length_s(1.0 / 60.0) == 0.0


def test_refuses_more_command_levels_than_int32_holds():
    with pytest.raises(InputError, match="levels"):
        dataclasses.replace(make_task("velocity-flat").levels[0], levels=2**32)
