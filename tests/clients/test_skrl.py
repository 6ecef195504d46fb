"""skrl: its Gymnasium wrapper without an adapter."""

import gymnasium
import numpy as np
import pytest
import torch
from skrl.envs.wrappers.torch import wrap_env

from jumper_warp.gym import env_id

N = 4


@pytest.mark.filterwarnings("ignore:To copy construct from a tensor")
@pytest.mark.parametrize("tensors", [False, True])
def test_wrapped_environment_steps_on_its_own_device(tensors):
    envs, plain = (gymnasium.make_vec(env_id("vertical-jump"), num_envs=N, device="cpu", tensors=each)
                   for each in (tensors, False))  # fmt: skip
    env = wrap_env(envs)
    assert (env.device, env.num_envs) == (envs.device, N)
    obs, _ = env.reset()
    plain.reset(seed=env._env.unwrapped.env.seed)
    ended = False
    for action in torch.rand(80, N, 12) * 2.0 - 1.0:
        obs, reward, terminated, truncated, _ = env.step(action)
        expected = plain.step(action)
        for value, array in zip((obs, reward[:, 0], terminated[:, 0], truncated[:, 0]), expected, strict=False):
            np.testing.assert_array_equal(value, array)
        ended = ended or bool((terminated | truncated).any())
    assert ended
