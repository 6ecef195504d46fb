"""Gymnasium: autoreset modes, vector wrappers, one-world environments, statistics of episodes."""

import copy
import pickle
import re
import warnings
from functools import partial
from typing import ClassVar

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AutoresetMode
from gymnasium.wrappers import RecordVideo
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


@pytest.mark.parametrize("mode", MODES)
def test_mode_is_where_wrappers_look(mode):
    envs = gymnasium.make_vec("jumper_warp/VerticalJump-v0", num_envs=2, device="cpu", autoreset_mode=mode.value)
    assert envs.autoreset_mode is envs.metadata["autoreset_mode"] is mode
    assert envs.device == torch.device("cpu")


def test_unknown_mode_is_refused():
    with pytest.raises(ValueError, match="autoreset_mode must be one of 'NextStep', 'SameStep', 'Disabled'"):
        vector("sometimes")


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
def test_every_mode_counts_an_episode_once(mode):
    envs = vector(mode)
    envs.reset()
    ends = sum(int((terminated | truncated).sum()) for _, _, terminated, truncated, _ in play(envs))
    assert envs.env.skills[0].counters.termination_count.numpy().sum() == ends > N


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


@pytest.mark.parametrize("mask", [np.zeros(N, dtype=bool), np.ones(N - 1, dtype=bool), np.ones(N), "all"])
def test_other_masks_are_refused(mask):
    envs = vector(AutoresetMode.DISABLED)
    envs.reset()
    with pytest.raises(ValueError, match=f"reset_mask must be bool of shape \\({N},\\) with a True"):
        envs.reset(options={"reset_mask": mask})


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


@pytest.mark.parametrize("tensors", [False, True])
def test_arrays_and_tensors_are_accepted_as_actions(tensors):
    envs = [vector(tensors=tensors) for _ in range(2)]
    for each in envs:
        each.reset()
    for action in ACTIONS:
        for a, b in zip(envs[0].step(action)[:4], envs[1].step(torch.from_numpy(action))[:4], strict=True):
            np.testing.assert_array_equal(a, b)


# ---------------------------------------------------------------- Gymnasium's vector wrappers

INAPPLICABLE = {"GrayscaleObservation", "ResizeObservation", "HumanRendering", "JaxToNumpy", "JaxToTorch"}
"""Wrappers of images, of a window and of JAX."""
WRAPPERS = {
    "VectorizeTransformObservation": {
        "wrapper": gymnasium.wrappers.TransformObservation, "func": np.tanh, "observation_space": None,
    },
    "VectorizeTransformAction": {
        "wrapper": gymnasium.wrappers.TransformAction, "func": np.tanh, "action_space": None,
    },
    "VectorizeTransformReward": {"wrapper": gymnasium.wrappers.TransformReward, "func": np.tanh},
    "DictInfoToList": {},
    "TransformObservation": {"func": np.tanh},
    "FilterObservation": {"filter_keys": ["actor"]},
    "FlattenObservation": {},
    "ReshapeObservation": {"shape": (-1, 1)},
    "RescaleObservation": {"min_obs": np.float32(-1.0), "max_obs": np.float32(1.0)},
    "DtypeObservation": {"dtype": np.float64},
    "NormalizeObservation": {},
    "TransformAction": {"func": np.tanh},
    "ClipAction": {},
    "RescaleAction": {"min_action": np.float32(-2.0), "max_action": np.float32(2.0)},
    "TransformReward": {"func": np.tanh},
    "ClipReward": {"min_reward": -1.0, "max_reward": 1.0},
    "NormalizeReward": {},
    "RecordEpisodeStatistics": {},
    "RecordVideo": {"video_length": 3},
    "ArrayConversion": {"env_xp": np, "target_xp": torch},
    "NumpyToTorch": {},
}  # fmt: skip
"""Arguments of every other vector wrapper."""
CONVERSIONS = {"ArrayConversion", "NumpyToTorch"}
CASES = [(name, mode) for name in WRAPPERS for mode in MODES
         if not (name in CONVERSIONS and mode is AutoresetMode.SAME_STEP)]  # fmt: skip
"""Wrappers with modes; conversions have no array of objects, which `final_obs` is in SAME_STEP."""


def test_every_vector_wrapper_is_listed():
    assert WRAPPERS.keys() | INAPPLICABLE == set(wrappers.__all__)


class Blank(gymnasium.Env):
    """Environment of the same spaces without robots, for Gymnasium's own vector environment."""

    metadata: ClassVar = {"render_modes": ["rgb_array"], "render_fps": 60}
    render_mode = "rgb_array"

    def __init__(self, envs: GymVectorEnv):
        self.observation_space, self.action_space = envs.single_observation_space, envs.single_action_space


def gymnasiums_refusal(wrap, envs, mode):
    """Return the message by which a wrapper refuses Gymnasium's own vector environment, None if it works there."""
    reference = gymnasium.vector.SyncVectorEnv([lambda: Blank(envs)] * N, autoreset_mode=mode)
    try:
        wrap(reference)
    except ValueError as error:
        return str(error)
    return None


@pytest.mark.parametrize(("name", "mode"), CASES)
def test_vector_wrapper_works_in_the_modes_that_gymnasium_has_it_for(name, mode, tmp_path):
    if module := {"RecordVideo": "moviepy", **dict.fromkeys(CONVERSIONS, "array_api_compat")}.get(name):
        pytest.importorskip(module)
    film = {"render_mode": "rgb_array", "render_size": (64, 48), "render_envs": 2} if name == "RecordVideo" else {}
    envs = vector(mode, all_groups=name in ("FilterObservation", "FlattenObservation"), **film)
    arguments = dict(WRAPPERS[name])
    if name == "ReshapeObservation":
        arguments["shape"] = (envs.env.num_obs, 1)
    wrap = partial(getattr(wrappers, name), **arguments)
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", ".*autoreset mode is same-step")
        if name not in {*CONVERSIONS, "RecordVideo"} and (refusal := gymnasiums_refusal(wrap, envs, mode)):
            with pytest.raises(ValueError, match=re.escape(refusal)):
                wrap(envs)
            assert "autoreset_mode" in refusal
            return
        wrapped = wrap(envs, **({"video_folder": str(tmp_path / "films")} if film else {}))
    tensors = name in CONVERSIONS
    obs, _ = wrapped.reset(seed=1)
    assert tensors or obs in wrapped.observation_space
    ends = 0
    for action in ACTIONS:
        obs, reward, terminated, truncated, _ = wrapped.step(torch.from_numpy(action) if tensors else action)
        assert isinstance(obs, torch.Tensor) if tensors else obs in wrapped.observation_space
        assert np.isfinite(np.asarray(reward)).all() and reward.shape == (N,)
        ended = np.asarray(terminated | truncated)
        ends += ended.sum()
        if mode is AutoresetMode.DISABLED and ended.any():
            wrapped.reset(options={"reset_mask": ended})
    assert ends > N
    wrapped.close()
    assert name != "RecordVideo" or any((tmp_path / "films").glob("*.mp4"))


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


def test_gymnasiums_own_vector_environment_works_on_it():
    envs = gymnasium.make_vec("jumper_warp/VerticalJump-v0", num_envs=2, vectorization_mode="sync", device="cpu")
    assert envs.reset(seed=1)[0] in envs.observation_space
    assert envs.step(np.zeros((2, 12), dtype=np.float32))[0] in envs.observation_space
    envs.close()


def test_record_video_films_one_world(tmp_path):
    pytest.importorskip("moviepy", reason="RecordVideo needs moviepy")
    env = gymnasium.make("jumper_warp/VerticalJump-v0", device="cpu", render_mode="rgb_array", render_size=(64, 48))
    env = RecordVideo(env, str(tmp_path / "films"), video_length=3)
    env.reset(seed=1)
    for action in ACTIONS[:5, 0]:
        env.step(action)
    env.close()
    assert any((tmp_path / "films").glob("*.mp4"))


@pytest.mark.parametrize("copied", [pickle.dumps, copy.deepcopy])
def test_pickle_and_deep_copy_are_refused_with_the_reason(copied):
    for envs in (vector(), GymEnv(Env(TASK, 1, device="cpu"))):
        envs.reset()
        with pytest.raises(TypeError, match=r"Env can be neither copied nor pickled: .*make another one"):
            copied(envs)


def test_several_worlds_are_refused_by_make():
    with pytest.raises(ValueError, match="make_vec takes num_envs"):
        GymEnv(Env(TASK, 2, device="cpu"))
