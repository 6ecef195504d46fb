import numpy as np
import pytest

from jump_helpers import make_env
from jumper_warp.registry import make_task
from jumper_warp.rl.cfg import PpoCfg
from jumper_warp.rl.torch.ppo import Ppo

N = 8
LIMIT = 24  # policy steps of the longest episode
TASK = make_task("vertical-jump").with_terms("terminations", too_long={"steps": float(LIMIT)})


def record_steps(env):
    """Let env.step append (reward (N,), terms (terms, N), done (N,)) to the returned list."""
    steps, step = [], env.step

    def recorded(action):
        step(action)
        terms = np.stack([values.numpy().copy() for values in env.reward_terms.values()])
        steps.append((env.reward.numpy().copy(), terms, env.done.numpy() > 0.0))

    env.step = recorded
    return steps


def ended_episodes(steps):
    """Return reward sums, lengths and sums of terms of the ended episodes, by policy step of their end."""
    start, ended = np.zeros(N, dtype=int), []
    for end, (_, _, done) in enumerate(steps, 1):
        for world in np.flatnonzero(done):
            episode = steps[start[world] : end]
            total, terms = (sum(step[i][..., world].astype(float) for step in episode) for i in (0, 1))
            ended.append((end, total, len(episode), terms))
            start[world] = end
    return ended


def test_logged_rewards_are_means_over_the_episodes_that_ended_since_the_last_log():
    env = make_env(N, task=TASK, randomize=True, seed=3)
    steps, ppo = record_steps(env), Ppo(env, PpoCfg(num_steps=40, hidden=(8,), minibatches=1, epochs=1))
    env.reset()
    lengths = []
    for iteration in range(1, 3):
        ppo.iterate()
        metrics = {**ppo.statistics(), **env.metrics()}
        new = [episode for episode in ended_episodes(steps) if episode[0] > 40 * (iteration - 1)]
        totals, length, terms = (np.mean([episode[i] for episode in new], axis=0) for i in (1, 2, 3))
        assert metrics["Train/mean_reward"] == pytest.approx(totals, rel=1e-5)
        assert metrics["Train/mean_episode_length"] == length
        logged = [metrics[f"Episode_Reward/{name}"] for name in env.reward_terms]
        np.testing.assert_allclose(logged, terms / (LIMIT / 60.0), rtol=1e-4, atol=1e-6)
        assert np.count_nonzero(terms) > 10
        lengths += [episode[2] for episode in new]
    assert len(set(lengths)) > 3 and max(lengths) == LIMIT
