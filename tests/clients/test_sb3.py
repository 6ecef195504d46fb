"""Stable-Baselines3: the adapter, PPO, and SB3's own wrappers and helpers."""

import gymnasium
import numpy as np
from stable_baselines3 import PPO
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.vec_env import VecMonitor, VecNormalize

from jumper_warp.envs.env import Env
from jumper_warp.envs.gymnasium import GymVectorEnv
from jumper_warp.envs.sb3 import Sb3VecEnv
from jumper_warp.gym import env_id
from jumper_warp.registry import make_task

N, STEPS = 6, 30
TASK = make_task("vertical-jump").with_terms("terminations", too_long={"steps": 12.0}, tilted={"angle": 0.15})
ACTIONS = np.random.default_rng(0).uniform(-1.0, 1.0, (STEPS, N, 12)).astype(np.float32)


def vector(**arguments):
    return GymVectorEnv(Env(TASK, N, device="cpu", seed=3), **arguments)


def test_ppo_trains_on_a_named_task(one_thread):
    envs = Sb3VecEnv(gymnasium.make_vec(env_id("vertical-jump"), num_envs=16, device="cpu"))
    model = PPO("MlpPolicy", envs, n_steps=64, batch_size=256, n_epochs=2, seed=0, device="cpu")
    before = [p.detach().clone() for p in model.policy.parameters()]
    model.learn(4096)
    assert model.num_timesteps == 4096 and len(model.ep_info_buffer) > 0
    assert any((a != b).any() for a, b in zip(before, model.policy.parameters(), strict=True))


def test_steps_and_infos_are_those_of_the_vector_environment():
    envs, plain = Sb3VecEnv(vector()), vector()
    np.testing.assert_array_equal(envs.reset(), plain.reset()[0])
    ends = set()
    for action in ACTIONS:
        obs, rewards, dones, infos = envs.step(action)
        expected = plain.step(action)
        np.testing.assert_array_equal(obs, expected[0])
        np.testing.assert_array_equal(rewards, expected[1])
        np.testing.assert_array_equal(dones, expected[2] | expected[3])
        for world, info in enumerate(infos):
            assert bool(info) == dones[world]
            if info:
                np.testing.assert_array_equal(info["terminal_observation"], expected[4]["final_obs"][world])
                assert info["TimeLimit.truncated"] == expected[3][world] == (info["termination"] == "too_long")
                assert info["episode"]["l"] == expected[4]["final_info"]["episode"]["l"][world]
                ends.add(info["termination"])
    assert {"too_long", "tilted"} <= ends


def test_sb3s_wrappers_and_evaluation_work():
    envs = VecNormalize(VecMonitor(Sb3VecEnv(vector())))
    envs.reset()
    episodes = [info["episode"] for action in ACTIONS for info in envs.step(action)[3] if info]
    assert episodes and max(episode["l"] for episode in episodes) == 12
    model = PPO("MlpPolicy", envs, n_steps=16, batch_size=N * 16, device="cpu")
    _, lengths = evaluate_policy(model, VecMonitor(Sb3VecEnv(vector())), n_eval_episodes=4, return_episode_rewards=True)
    assert len(lengths) == 4 and max(lengths) <= 12
