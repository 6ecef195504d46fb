"""Gymnasium: autoreset modes, vector wrappers, one-world environments, statistics of episodes."""

import dataclasses

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
from jumper_warp.tasks.randomization import RandomizationCfg

N, STEPS, LIMIT = 6, 40, 12
TASK = make_task("vertical-jump").with_terms("terminations", too_long={"steps": float(LIMIT)}, tilted={"angle": 0.15})
"""Episodes that end by time and by failure within a few steps."""
ACTIONS = np.random.default_rng(0).uniform(-1.0, 1.0, (STEPS, N, 12)).astype(np.float32)
MODES = list(AutoresetMode)

pytestmark = pytest.mark.filterwarnings("error::UserWarning")


def vector(mode=AutoresetMode.SAME_STEP, task=TASK, seed=3, **arguments) -> GymVectorEnv:
    return GymVectorEnv(Env(task, N, device="cpu", seed=seed), autoreset_mode=mode, **arguments)


def plain(**arguments) -> Env:
    """Return the environment that `vector` wraps; arguments: of `Env`."""
    return Env(TASK, N, device="cpu", seed=3, **arguments)


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
@pytest.mark.parametrize("mode", MODES)
def test_step_that_ends_an_episode_has_its_last_observation_and_termination(mode, tensors):
    envs, unreset, reset = vector(mode, tensors=tensors), plain(auto_reset=False), plain()
    for each in (envs, unreset, reset):
        each.reset()
    first = np.ones(N, dtype=bool)  # worlds in their first episode, where the environment without resets can follow
    same_step = mode is AutoresetMode.SAME_STEP
    for action in ACTIONS:
        *values, infos = envs.step(action)
        obs, reward, terminated, truncated = map(np.array, values)
        old, new = unreset.step(torch.from_numpy(action)), reset.step(torch.from_numpy(action))
        ended = terminated | truncated
        assert ("final_obs" in infos) == (same_step and (tensors or ended.any()))
        if same_step:
            np.testing.assert_array_equal(obs, new.obs["actor"])
            for world in np.flatnonzero(ended):
                assert not np.array_equal(obs[world], infos["final_obs"][world])
                obs[world] = infos["final_obs"][world]
            infos = infos.get("final_info", infos)
        for found, expected in ((obs, old.obs["actor"]), (reward, old.reward), (terminated, old.terminated),
                                (truncated, old.truncated)):  # fmt: skip
            np.testing.assert_array_equal(found[first], expected.numpy()[first])
        np.testing.assert_array_equal(np.asarray(infos.get("_termination", np.zeros(N, dtype=bool))), ended)
        for world in np.flatnonzero(ended):
            assert (envs.endings[infos["termination"][world]] in ("too_long", "success")) == truncated[world]
        first &= ~ended
        if mode is AutoresetMode.DISABLED and ended.any():
            envs.reset(options={"reset_mask": ended})
    assert not first.any()


def test_next_step_ignores_the_action_after_an_end_and_returns_a_first_observation():
    envs, other = vector(AutoresetMode.NEXT_STEP), vector(AutoresetMode.NEXT_STEP)
    envs.reset(), other.reset()
    begun, count = np.zeros(N, dtype=bool), 0
    for action in ACTIONS:
        changed = np.where(begun[:, None], np.nan, action)
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
    ended = np.array([truncated for _, _, _, truncated, _ in results])
    gaps = np.concatenate([np.diff(np.flatnonzero(world)) for world in ended.T])
    assert gaps.min() == LIMIT + (mode is AutoresetMode.NEXT_STEP)


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


# ---------------------------------------------------------------- spaces, data and seeds


@pytest.mark.parametrize("all_groups", [False, True])
def test_step_results_are_in_their_spaces(all_groups):
    envs = vector(all_groups=all_groups)
    assert envs.single_action_space == gymnasium.spaces.Box(-1.0, 1.0, (12,))
    space = envs.single_observation_space
    assert (space["actor"] if all_groups else space).shape == (envs.env.num_obs,)
    obs, infos = envs.reset(seed=1)
    assert obs in envs.observation_space and infos == {}
    results = play(envs)
    for obs, reward, terminated, truncated, _ in results:
        assert obs in envs.observation_space
        assert (reward.shape, reward.dtype) == ((N,), np.float32)
        assert (terminated.shape, terminated.dtype) == (truncated.shape, truncated.dtype) == ((N,), np.bool_)
    finals = [row for *_, infos in results for row in infos.get("final_obs", []) if row is not None]
    assert len(finals) > N
    assert all(row in space for row in finals)


@pytest.mark.parametrize("tensors", [False, True])
def test_step_results_are_copies(tensors):
    envs = vector(tensors=tensors)
    actions = torch.from_numpy(ACTIONS) if tensors else ACTIONS
    results = [envs.reset(seed=2)[0]]
    for *values, infos in [envs.step(action) for action in actions[:13]]:
        results += [*values, *(infos[name] for name in ("_final_obs", "_final_info") if name in infos)]
    copies = [value.clone() if tensors else value.copy() for value in results]
    for action in actions[13:]:
        envs.step(action)
    for value, copy in zip(results, copies, strict=True):
        np.testing.assert_array_equal(value, copy)


@pytest.mark.parametrize("resample_at", ["reset", "startup"])
def test_reset_with_a_seed_equals_a_new_environment_with_it(resample_at):
    task = dataclasses.replace(TASK, randomization=RandomizationCfg(resample_at=resample_at))
    envs, new = (vector(task=task, seed=seed) for seed in (1, 5))
    envs.reset()
    play(envs)
    envs.env.episodes.level.fill_(2)  # as after promotions by the curriculum
    np.testing.assert_array_equal(envs.reset(seed=5)[0], new.reset()[0])
    for step, other in zip(play(envs), play(new), strict=True):
        for value, expected in zip(step[:4], other[:4], strict=True):
            np.testing.assert_array_equal(value, expected)
    np.testing.assert_array_equal(envs.reset()[0], new.reset()[0])


def test_equal_seeds_reproduce_and_others_differ():
    envs = vector()
    first, other, again = (envs.reset(seed=seed)[0] for seed in (5, 6, 5))
    np.testing.assert_array_equal(first, again)
    assert (first != other).any(axis=1).all()
    assert (envs.reset()[0] != first).any(axis=1).all()  # without a seed the random numbers continue


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
