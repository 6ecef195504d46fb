"""Gymnasium: autoreset modes, vector wrappers, one-world environments, statistics of episodes."""

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AutoresetMode
from gymnasium.wrappers import vector as wrappers

from jumper_warp.envs.env import Env
from jumper_warp.envs.gymnasium import GymEnv, GymVectorEnv
from jumper_warp.gym import env_id
from jumper_warp.registry import make_task

N, STEPS, LIMIT = 6, 40, 12
TASK = make_task("vertical-jump").with_terms("terminations", too_long={"steps": float(LIMIT)}, tilted={"angle": 0.15})
"""Episodes that end by time and by failure within a few steps."""
ACTIONS = np.random.default_rng(0).uniform(-1.0, 1.0, (STEPS, N, 12)).astype(np.float32)
MODES = list(AutoresetMode)

pytestmark = pytest.mark.filterwarnings("error::UserWarning")


def vector(mode=AutoresetMode.SAME_STEP, task=TASK, seed=3, **arguments) -> GymVectorEnv:
    return GymVectorEnv(Env(task, N, device="cpu", seed=seed), autoreset_mode=mode, **arguments)


def play(envs, steps=STEPS):
    """Return the results of some steps; without automatic resets, reset ended worlds after each."""
    results = []
    for action in ACTIONS[:steps]:
        results.append(envs.step(action))
        ended = results[-1][2] | results[-1][3]
        if envs.metadata["autoreset_mode"] is AutoresetMode.DISABLED and ended.any():
            envs.reset(options={"reset_mask": ended})
    return results


# ---------------------------------------------------------------- autoreset modes


@pytest.mark.parametrize("tensors", [False, True])
@pytest.mark.parametrize("mode", [AutoresetMode.NEXT_STEP, AutoresetMode.DISABLED])
def test_step_that_ends_an_episode_returns_its_last_observation(mode, tensors):
    envs, unreset = vector(mode, tensors=tensors), Env(TASK, N, device="cpu", seed=3, auto_reset=False)
    envs.reset(), unreset.reset()
    first = np.ones(N, dtype=bool)  # worlds in their first episode, where the environment without resets can follow
    for action in ACTIONS:
        *values, infos = envs.step(action)
        obs, reward, terminated, truncated = map(np.asarray, values)
        old = unreset.step(torch.from_numpy(action))
        for new, expected in ((obs, old.obs["actor"]), (reward, old.reward), (terminated, old.terminated),
                              (truncated, old.truncated)):  # fmt: skip
            np.testing.assert_array_equal(new[first], expected.numpy()[first])
        ended = terminated | truncated
        np.testing.assert_array_equal(np.asarray(infos.get("_termination", np.zeros(N, dtype=bool))), ended)
        for world in np.flatnonzero(ended):
            assert (envs.endings[infos["termination"][world]] in ("too_long", "success")) == truncated[world]
        assert not {"final_obs", "final_info"} & infos.keys()
        first &= ~ended
        if mode is AutoresetMode.DISABLED and ended.any():
            envs.reset(options={"reset_mask": ended})
    assert not first.any()


def test_next_step_ignores_the_action_after_an_end_and_returns_a_first_observation():
    envs, other = vector(AutoresetMode.NEXT_STEP), vector(AutoresetMode.NEXT_STEP)
    envs.reset(), other.reset()
    begun, count = np.zeros(N, dtype=bool), 0
    for action in ACTIONS:
        changed = np.where(begun[:, None], -action, action)
        obs, reward, terminated, truncated, _ = envs.step(action)
        for a, b in zip((obs, reward, terminated, truncated), other.step(changed)[:4], strict=True):
            np.testing.assert_array_equal(a, b)
        assert not reward[begun].any() and not terminated[begun].any() and not truncated[begun].any()
        count += begun.sum()
        begun = terminated | truncated
    assert count > N


@pytest.mark.parametrize("mode", MODES)
def test_episodes_have_the_same_length_in_every_mode(mode):
    task = TASK.with_terms("terminations", tilted={"angle": 3.0})
    envs = wrappers.RecordEpisodeStatistics(vector(mode, task))
    envs.reset()
    results = play(envs)
    lengths = set(envs.length_queue)
    assert max(lengths) == LIMIT
    ended = np.array([truncated for _, _, _, truncated, _ in results])[:, 0]
    between = LIMIT + (mode is AutoresetMode.NEXT_STEP)
    assert between in np.diff(np.flatnonzero(ended)) and between - 1 not in np.diff(np.flatnonzero(ended))


def test_reset_mask_leaves_the_other_worlds_alone():
    envs, unreset = (vector(AutoresetMode.DISABLED, TASK.with_terms("terminations", tilted={"angle": 3.0}))
                     for _ in range(2))  # fmt: skip
    before, _ = envs.reset()
    unreset.reset()
    for action in ACTIONS[:5]:
        before = envs.step(action)[0]
        unreset.step(action)
    mask = np.arange(N) % 2 == 0
    obs, _ = envs.reset(options={"reset_mask": mask})
    np.testing.assert_array_equal(obs[~mask], before[~mask])
    assert (obs[mask] != before[mask]).any(axis=1).all()
    np.testing.assert_array_equal(envs.step(ACTIONS[5])[0][~mask], unreset.step(ACTIONS[5])[0][~mask])


def test_ended_episode_has_to_be_reset_without_automatic_resets():
    envs = vector(AutoresetMode.DISABLED)
    envs.reset()
    with pytest.raises(gymnasium.error.ResetNeeded, match="reset_mask"):
        for action in ACTIONS:
            envs.step(action)


@pytest.mark.parametrize("mode", [AutoresetMode.NEXT_STEP, AutoresetMode.DISABLED])
def test_commands_are_resampled_within_an_episode(mode):
    task, still = make_task("velocity-flat"), np.zeros((N, 12), dtype=np.float32)
    same, other = (GymVectorEnv(Env(task, N, device="cpu", seed=1, randomize=False), autoreset_mode=each)
                   for each in (AutoresetMode.SAME_STEP, mode))  # fmt: skip
    same.reset(), other.reset()
    command = same.env.task_arrays()["command"]
    for _ in range(200):  # 3.3 s
        results = same.step(still), other.step(still)
        np.testing.assert_array_equal(results[0][0], results[1][0])
        assert not (results[0][2] | results[0][3]).any()
    assert (same.env.task_arrays()["command"] != command).any()


# ---------------------------------------------------------------- infos


@pytest.mark.parametrize("tensors", [False, True])
def test_final_info_has_the_statistics_that_the_wrapper_counts(tensors):
    envs, counted = vector(tensors=tensors), wrappers.RecordEpisodeStatistics(vector())
    envs.reset(), counted.reset()
    seen = 0
    for action in ACTIONS:
        *_, infos = envs.step(action)
        *_, expected = counted.step(action)
        if "episode" not in expected:
            assert tensors or not infos
            continue
        seen += 1
        episode = {name: np.asarray(values) for name, values in infos["final_info"]["episode"].items()}
        np.testing.assert_array_equal(np.asarray(infos["final_info"]["_episode"]), expected["_episode"])
        np.testing.assert_array_equal(episode["l"], expected["episode"]["l"])
        np.testing.assert_array_equal(episode["r"], expected["episode"]["r"])
        assert episode.keys() == expected["episode"].keys() and episode["l"].dtype == expected["episode"]["l"].dtype
        assert (episode["t"][expected["_episode"]] > 0.0).all() and (episode["t"][~expected["_episode"]] == 0.0).all()
    assert seen > 1


# ---------------------------------------------------------------- one world


@pytest.mark.parametrize("task", ["vertical-jump", "velocity-flat"])
def test_gymnasiums_checker_passes_without_warnings(task):
    env = gymnasium.make(env_id(task), device="cpu", render_size=(64, 48))
    assert isinstance(env.unwrapped, GymEnv)
    check_env(env.unwrapped)
    env.close()


def test_one_world_is_the_first_world_of_the_vector_environment():
    envs = GymVectorEnv(Env(make_task("vertical-jump"), 1, device="cpu"))
    env = gymnasium.make("jumper_warp/VerticalJump-v0", device="cpu")
    np.testing.assert_array_equal(env.reset(seed=5)[0], envs.reset(seed=5)[0][0])
    for action in ACTIONS[:, 0]:
        obs, reward, terminated, truncated, infos = env.step(action)
        expected = envs.step(action[None])
        if terminated or truncated:
            break
        np.testing.assert_array_equal(obs, expected[0][0])
        assert (reward, infos) == (expected[1][0], {})


def test_end_of_an_episode_is_explained():
    env = GymEnv(Env(TASK, 1, device="cpu"))
    env.reset(seed=1)
    for action in ACTIONS[:, 0]:
        *_, terminated, truncated, infos = env.step(action)
        if terminated or truncated:
            break
    assert infos == {"termination": "tilted" if terminated else "too_long"}
    with pytest.raises(gymnasium.error.ResetNeeded):
        env.step(ACTIONS[0, 0])
    env.reset()
    env.step(ACTIONS[0, 0])
