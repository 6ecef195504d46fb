"""Watching a training: buffer on the device, playback of episodes, and a training that no viewer changes."""

import os
import signal

import numpy as np
import pytest
import torch

from hold_height import hold_height
from jumper_warp.envs.env import Env
from jumper_warp.live.buffer import WorldBuffer
from jumper_warp.live.clips import ROLES, Player
from jumper_warp.live.scene import robot_scene
from jumper_warp.live.training import TrainingWatch
from jumper_warp.rl.checkpoint import load_checkpoint
from jumper_warp.training import train
from live_helpers import STEPS, short_training
from toy_task import equal

LAYOUT = {"world": (0, 1), "done": (1, 2), "rewards": (2, 3)}


@pytest.fixture(scope="module")
def env():
    """Return an environment of 12 worlds with short episodes."""
    env = Env(hold_height(), 12, device="cpu")
    env.reset()
    return env


def steps(env, count, on_step=lambda: None):
    """Make policy steps with the same random actions in each call."""
    generator = torch.Generator().manual_seed(0)
    for _ in range(count):
        env.step(torch.rand(env.num_envs, 12, generator=generator) - 0.5)
        on_step()


def test_buffer_has_the_environments_values_of_the_watched_worlds(env):
    buffer = WorldBuffer(env, STEPS)
    expected = []

    def on_step():
        buffer.record()
        arrays = env.task_arrays()
        terms = torch.stack(list(env.reward_terms.values()), dim=1).numpy().copy()
        expected.append((env.sim.joint_q().copy(), terms, env.done.numpy().copy(), arrays["goal"]))

    steps(env, STEPS, on_step)
    words = buffer.fetch()
    assert words.shape[:2] == (STEPS, len(ROLES))
    for row, (q, terms, done, goal) in zip(words, expected, strict=True):
        worlds = row[:, 0]
        part = {name: row[:, slice(*columns)] for name, columns in buffer.layout.items()}
        np.testing.assert_array_equal(part["joint_q"].view(np.float32), q[worlds])
        np.testing.assert_array_equal(part["rewards"].view(np.float32), terms[worlds])
        np.testing.assert_array_equal(part["done"].view(np.float32)[:, 0], done[worlds])
        states = [np.frombuffer(state.tobytes(), buffer.state_type)[0] for state in part["state"]]
        np.testing.assert_array_equal([state["goal"] for state in states], goal[worlds])


def test_watched_worlds_have_the_best_median_and_worst_last_return(env):
    buffer = WorldBuffer(env, STEPS)
    running = np.zeros(env.num_envs)
    last = np.full(env.num_envs, np.nan)
    changes = 0

    def on_step():
        nonlocal running
        buffer.record()
        running += env.reward.numpy()
        done = env.done.numpy() > 0.0
        last[done] = running[done]
        running = np.where(done, 0.0, running)

    before = None
    for _ in range(120):
        steps(env, STEPS, on_step)
        buffer.fetch()
        following = list(buffer._following)
        assert len(set(following)) == len(ROLES)
        if before is not None and following[0] != before[0]:
            others = [world for world in range(env.num_envs) if world not in before[1:] + following[1:]]
            finite = [world for world in others if np.isfinite(last[world])]
            changes += last[following[0]] >= max(last[world] for world in finite) - 1e-3
        before = following
    assert changes > 2


def test_link_poses_are_those_of_the_simulation(env):
    steps(env, 5)
    poses = robot_scene(env.sim.model).link_poses(env.sim.joint_q())
    expected = env.sim.links()[0]
    signs = np.sign((poses[..., 3:] * expected[..., 3:]).sum(axis=-1, keepdims=True))
    np.testing.assert_allclose(poses[..., :3], expected[..., :3], atol=1e-5)
    np.testing.assert_allclose(poses[..., 3:] * signs, expected[..., 3:], atol=1e-5)


def rows(world, ends, rewards):
    """Return words of LAYOUT of steps of one world; ends: which steps end an episode."""
    words = np.zeros((len(ends), 3), np.int32)
    words[:, 0] = world
    words[:, 1] = np.array(ends, np.float32).view(np.int32)
    words[:, 2] = np.array(rewards, np.float32).view(np.int32)
    return words


def shown(player, count):
    """Return the rewards of the next shown steps."""
    return player.take(count)[:, 2].view(np.float32).tolist()


def test_player_shows_whole_episodes_and_repeats_the_last():
    player = Player(LAYOUT)
    assert player.take(1) is None
    player.add(rows(3, [0, 0, 1, 0, 0], [1, 2, 3, 4, 5]))
    assert shown(player, 2) == [1, 2]  # the part of an episode that it has
    assert shown(player, 4) == [3, 4, 5, 5]  # a whole one, whose end is not recorded yet
    player.add(rows(3, [0, 1], [6, 7]))
    player.add(rows(8, [0, 0, 1, 0, 1], [8, 9, 10, 11, 12]))
    assert shown(player, 1) == [6]
    assert player.terms == [15.0]  # 4 + 5 + 6: the first step has the reward of the episode before
    assert shown(player, 3) == [12, 12, 12]  # the newest


def test_player_ignores_the_rest_of_an_episode_that_began_before_its_world_was_watched():
    player = Player(LAYOUT)
    player.add(rows(0, [1, 0], [1, 2]))
    player.add(rows(1, [0, 0], [8, 9]))
    assert shown(player, 4) == [1, 2, 1, 2]


def test_player_drops_an_episode_with_lost_steps():
    player = Player(LAYOUT)
    player.add(rows(0, [1, 0], [1, 2]))
    player.skip()
    player.add(rows(0, [0, 0], [7, 8]))
    assert shown(player, 4) == [1, 2, 1, 2]


class KilledWatch(TrainingWatch):
    """Watch whose viewer is killed after the second iteration."""

    def after_iteration(self, runs):
        super().after_iteration(runs)
        if runs[0].iteration == 2:
            os.kill(self.feed.process.pid, signal.SIGKILL)
            self.feed.process.wait()


def final_state(folder, observers=()):
    """Train, and return the state in the last checkpoint without settings and time."""
    result = train(short_training(folder), observers=observers)
    state = load_checkpoint(result.folder / "checkpoints" / "iteration_000004.pt")
    return {name: state[name] for name in ("iteration", "ppo", "env", "rng")}


def test_training_is_bitwise_the_same_with_a_viewer_and_after_it_is_killed(tmp_path):
    plain = final_state(tmp_path / "plain")
    for watch in (TrainingWatch("none", 1), KilledWatch("none", 1)):
        state = final_state(tmp_path / type(watch).__name__, [watch])
        assert equal(state, plain)
    assert watch.feed.broken
