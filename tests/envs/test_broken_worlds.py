"""Diverged worlds and non-finite actions: they end their own episode and change no other world."""

import math

import numpy as np
import pytest
import torch

from jump_helpers import edit_coordinates, edit_episodes, ending_names, make_env, only
from jumper_warp.envs.arrays import FIRST_STEP_COUNT
from jumper_warp.kernels.jump.state import LANDED

N = 32
REST = torch.zeros((N, 12))


@pytest.fixture(scope="module")
def env():
    """Return N nominal worlds without noise that start in the default pose."""
    return make_env(N, reset=only("default"))


NAN, INF = math.nan, math.inf
BROKEN = {
    "position": {"q": {0: NAN}},
    "height": {"q": {2: INF}},
    "motor angle": {"q": {8: NAN}},
    "huge motor angle": {"q": {8: 1.0e30}},
    "base velocity": {"qd": {1: NAN}},
    "turning": {"qd": {4: INF}},
    "motor rate": {"qd": {7: NAN}},
    "absurd velocity": {"qd": {2: 50.0}},
    "absurd turning": {"qd": {5: 400.0}},
    "absurd motor rate": {"qd": {9: 1.0e4}},
    "finite but huge": {"qd": {0: 1.0e13}},
}


SUCCEEDING = {"phase": LANDED, "phase_steps": 100}


@pytest.mark.parametrize(
    ("case", "episode"),
    [*((case, {}) for case in BROKEN), ("motor angle", SUCCEEDING), ("absurd velocity", SUCCEEDING)],
    ids=[*BROKEN, "motor angle at success", "absurd velocity at success"],
)
def test_a_diverged_world_ends_at_once_and_changes_no_other(env, case, episode):
    outcomes = []
    for diverged in (False, True):
        env.episodes.step_count.fill_(FIRST_STEP_COUNT)  # the same random numbers
        env.reset()
        edit_episodes(env, command_step=1000)
        if diverged:
            edit_coordinates(env, 9, **BROKEN[case])
            edit_episodes(env, 9, **episode)
        env.step(REST)
        ended = (ending_names(env)[9], env.reward[9].item(), env.timeout[9].item())
        tensors = (env.obs, env.critic_obs, env.final_obs, env.final_critic_obs, env.reward)
        outcomes.append([*(tensor.clone() for tensor in tensors), env.robot.diverged.numpy().copy()])
    assert ended == ("diverged", 0.0, 0.0)
    others = [world for world in range(N) if world != 9]
    for expected, found in zip(outcomes[0][:-1], outcomes[1][:-1], strict=True):
        assert torch.equal(expected[others], found[others])
        assert torch.isfinite(found).all()
    assert outcomes[1][0].abs().max() < 50.0  # observations of a new episode
    assert not outcomes[1][-1].any()


@pytest.mark.parametrize("value", [NAN, INF, -INF])
def test_a_nonfinite_action_is_counted_and_ends_the_episode_of_its_world_only(env, value):
    outcomes = []
    for wrong in (0.0, value):
        env.episodes.step_count.fill_(FIRST_STEP_COUNT)
        env.reset()
        edit_episodes(env, command_step=1000)
        env.metrics()
        action = REST.clone()
        action[4, 7] = wrong
        env.step(action)
        tensors = (env.obs, env.critic_obs, env.final_obs, env.final_critic_obs, env.reward)
        outcomes.append([*(tensor.clone().numpy() for tensor in tensors), env.sim.joint_q().copy()])
    others = [world for world in range(N) if world != 4]
    for expected, found in zip(*outcomes, strict=True):
        np.testing.assert_array_equal(expected[others], found[others])
        assert np.isfinite(found).all()
    assert ending_names(env) == ["" if world != 4 else "diverged" for world in range(N)]
    assert (env.reward[4].item(), env.done[4].item(), env.timeout[4].item()) == (0.0, 1.0, 0.0)
    assert not env.final_obs[4].any() and env.metrics()["Metrics/bad_actions"] == 1.0
    env.step(REST)  # the next action is finite
    assert ending_names(env) == [""] * N and env.metrics()["Metrics/bad_actions"] == 0.0
