import dataclasses

import gymnasium
import numpy as np
import pytest
import torch
from rsl_rl.runners import OnPolicyRunner
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from jumper_warp.envs.env import Env
from jumper_warp.envs.gymnasium import GymVectorEnv
from jumper_warp.envs.rsl_rl import RslRlVecEnv
from jumper_warp.registry import make_task
from jumper_warp.rl.learner import STATISTICS
from jumper_warp.rl.rsl_rl import rsl_rl_config
from jumper_warp.rl.training_run import LEARNING, PERF
from jumper_warp.tasks.randomization import RandomizationCfg
from toy_task import SMALL

N, STEPS = 8, 40
TASK = make_task("vertical-jump")
SHORT = TASK.with_terms("terminations", too_long={"steps": 12.0}, tilted={"angle": 0.15})
"""Task whose episodes end by time and by failure within a few steps."""
ACTIONS = 2.0 * np.random.default_rng(0).random((STEPS, N, 12), dtype=np.float32) - 1.0

pytestmark = pytest.mark.filterwarnings("error::UserWarning:gymnasium")


def jumper(num_envs=N, task=SHORT, **arguments) -> Env:
    """Return an environment of short episodes on the CPU; arguments: of `Env`."""
    return Env(task, num_envs, device="cpu", **arguments)


def played(envs, actions=ACTIONS):
    """Return the results of all steps."""
    return [envs.step(action) for action in actions]


def assert_same(first, second):
    """Assert that two lists of (observation, reward, terminated, truncated, info) are equal but for info."""
    for step, other in zip(first, second, strict=True):
        for value, expected in zip(step[:4], other[:4], strict=True):
            np.testing.assert_array_equal(value, expected)


# ---------------------------------------------------------------- Gymnasium: spaces and data


@pytest.mark.parametrize("all_groups", [False, True])
def test_step_results_are_in_their_spaces(all_groups):
    envs = GymVectorEnv(jumper(), all_groups=all_groups)
    assert envs.single_action_space == gymnasium.spaces.Box(-1.0, 1.0, (12,))
    space = envs.single_observation_space
    assert (space["actor"] if all_groups else space).shape == (envs.env.num_obs,)
    obs, infos = envs.reset(seed=1)
    assert obs in envs.observation_space and infos == {}
    results = played(envs)
    for obs, reward, terminated, truncated, _ in results:
        assert obs in envs.observation_space
        assert (reward.shape, reward.dtype) == ((N,), np.float32)
        assert (terminated.shape, terminated.dtype) == (truncated.shape, truncated.dtype) == ((N,), np.bool_)
    finals = [row for *_, infos in results for row in infos.get("final_obs", []) if row is not None]
    assert len(finals) > N
    assert all(row in space for row in finals)


@pytest.mark.parametrize("tensors", [False, True])
def test_step_results_are_copies(tensors):
    envs = GymVectorEnv(jumper(), tensors=tensors)
    actions = torch.from_numpy(ACTIONS) if tensors else ACTIONS
    results = [envs.reset(seed=2)[0]]
    for *values, infos in played(envs, actions[:13]):
        results += [*values, *(infos[name] for name in ("_final_obs", "_final_info") if name in infos)]
    copies = [value.clone() if tensors else value.copy() for value in results]
    played(envs, actions[13:])
    for value, copy in zip(results, copies, strict=True):
        np.testing.assert_array_equal(value, copy)


# ---------------------------------------------------------------- Gymnasium: episodes


def test_an_ended_episode_is_reset_in_the_same_step():
    envs, unreset, reset = GymVectorEnv(jumper(seed=3)), jumper(seed=3, auto_reset=False), jumper(seed=3)
    assert envs.metadata["autoreset_mode"] is gymnasium.vector.AutoresetMode.SAME_STEP
    envs.reset()
    unreset.reset()
    reset.reset()
    first = np.ones(N, dtype=bool)  # worlds in their first episode, where the unreset environment can follow
    seen = np.zeros(2, dtype=int)
    for action in ACTIONS:
        obs, reward, terminated, truncated, infos = envs.step(action)
        old, new = unreset.step(torch.from_numpy(action)), reset.step(torch.from_numpy(action))
        np.testing.assert_array_equal(obs, new.obs["actor"])
        np.testing.assert_array_equal(reward[first], old.reward.numpy()[first])
        np.testing.assert_array_equal(terminated[first], old.terminated.numpy()[first])
        np.testing.assert_array_equal(truncated[first], old.truncated.numpy()[first])
        ended = terminated | truncated
        np.testing.assert_array_equal(infos.get("_final_obs", np.zeros(N, dtype=bool)), ended)
        for world in np.flatnonzero(ended & first):
            np.testing.assert_array_equal(infos["final_obs"][world], old.obs["actor"][world])
            assert not np.array_equal(obs[world], old.obs["actor"][world])
        if ended.any():
            assert all(row is None for row in infos["final_obs"][~ended])
        seen += [(terminated & first).sum(), (truncated & first).sum()]
        first &= ~ended
    assert not first.any() and (seen > 0).all(), seen


def test_final_info_names_the_termination():
    envs = GymVectorEnv(jumper())
    envs.reset()
    seen = set()
    for _, _, terminated, truncated, infos in played(envs):
        for world in np.flatnonzero(terminated | truncated):
            assert infos["_final_info"][world] and infos["final_info"]["_termination"][world]
            name = envs.endings[infos["final_info"]["termination"][world]]
            assert (name in ("too_long", "success")) == truncated[world]
            seen.add(name)
    assert {"too_long", "tilted"} <= seen


def test_tensors_equal_arrays():
    arrays, tensors = GymVectorEnv(jumper(seed=3), all_groups=True), GymVectorEnv(
        jumper(seed=3), all_groups=True, tensors=True
    )  # fmt: skip
    arrays.reset()
    assert isinstance(tensors.reset()[0]["critic"], torch.Tensor)
    for action in ACTIONS:
        obs, *values, infos = arrays.step(action)
        other, *others, other_infos = tensors.step(torch.from_numpy(action))
        for a, b in zip([*obs.values(), *values], [*other.values(), *others], strict=True):
            assert isinstance(b, torch.Tensor)
            np.testing.assert_array_equal(a, b)
        for world in np.flatnonzero(other_infos["_final_obs"]):
            for group in ("actor", "critic"):
                np.testing.assert_array_equal(infos["final_obs"][world][group], other_infos["final_obs"][group][world])
        if "final_info" in infos:
            np.testing.assert_array_equal(infos["final_info"]["termination"], other_infos["final_info"]["termination"])


# ---------------------------------------------------------------- Gymnasium: seeds


@pytest.mark.parametrize("resample_at", ["reset", "startup"])
def test_reset_with_a_seed_equals_a_new_environment_with_it(resample_at):
    task = dataclasses.replace(SHORT, randomization=RandomizationCfg(resample_at=resample_at))
    envs, new = (GymVectorEnv(jumper(task=task, seed=seed)) for seed in (1, 5))
    envs.reset()
    played(envs)
    envs.env.episodes.level.fill_(2)  # as after promotions by the curriculum
    np.testing.assert_array_equal(envs.reset(seed=5)[0], new.reset()[0])
    assert_same(played(envs), played(new))
    np.testing.assert_array_equal(envs.reset()[0], new.reset()[0])


def test_equal_seeds_reproduce_and_others_differ():
    envs = GymVectorEnv(jumper())
    first, other, again = (envs.reset(seed=seed)[0] for seed in (5, 6, 5))
    np.testing.assert_array_equal(first, again)
    assert (first != other).any(axis=1).all()
    assert (envs.reset()[0] != first).any(axis=1).all()  # without a seed the random numbers continue


# ---------------------------------------------------------------- rsl-rl


def test_rsl_rl_bootstraps_time_outs_but_not_failures(one_thread):
    torch.manual_seed(0)
    adapter = RslRlVecEnv(jumper(16, seed=3), metrics_every=100)
    obs, _ = adapter.reset()
    config = rsl_rl_config(dataclasses.replace(SMALL, gamma=0.9), 100, 0)
    algorithm = OnPolicyRunner(adapter, config, log_dir=None, device="cpu").alg
    rewards, dones, time_outs = [], [], []
    with torch.inference_mode():
        for _ in range(SMALL.num_steps):
            obs, reward, done, extras = adapter.step(algorithm.act(obs))
            rewards.append(reward.clone())
            dones.append(done)
            time_outs.append(extras["time_outs"])
            algorithm.process_env_step(obs, reward, done, extras)
    reward, done, time_out = torch.stack(rewards), torch.stack(dones), torch.stack(time_outs)
    stored, value = algorithm.storage.rewards.squeeze(-1), algorithm.storage.values.squeeze(-1)
    torch.testing.assert_close(stored, reward + 0.9 * time_out * value)
    assert time_out.any() and (done.bool() & ~time_out.bool()).any()
    assert (stored - reward)[time_out.bool()].abs().min() > 1.0e-4


def test_rsl_rl_logs_the_keys_of_this_packages_trainer(tmp_path, one_thread):
    adapter = RslRlVecEnv(jumper(4), metrics_every=SMALL.num_steps)
    adapter.reset()
    OnPolicyRunner(adapter, rsl_rl_config(SMALL, 1, 0), log_dir=str(tmp_path), device="cpu").learn(2)
    assert (tmp_path / "model_1.pt").exists()
    events = EventAccumulator(str(tmp_path))
    events.Reload()
    assert [event.step for event in events.Scalars("Episode_Termination/too_long")] == [0, 1]
    theirs = {name for name in events.Tags()["scalars"] if not name.endswith("/time")}
    metrics = adapter.env.metrics().keys()
    assert metrics | {"Train/mean_reward", "Train/mean_episode_length"} <= theirs
    assert theirs - metrics <= {*PERF, *LEARNING, *(f"Loss/{name}" for name in STATISTICS)}
