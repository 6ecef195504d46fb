"""TorchRL: GymWrapper without an adapter."""

import gymnasium
import pytest
import torch
from torchrl.envs import GymWrapper
from torchrl.envs.utils import check_env_specs

from jumper_warp.gym import env_id

N = 4


@pytest.mark.parametrize("tensors", [False, True])
def test_specs_match_and_rollouts_pass_ends(tensors):
    envs = gymnasium.make_vec(env_id("vertical-jump"), num_envs=N, device="cpu", tensors=tensors)
    env = GymWrapper(envs, device="cpu")
    check_env_specs(env)
    rollout = env.rollout(120, break_when_any_done=False)
    done = rollout["next", "done"][:, :-1, 0]
    assert rollout.batch_size == (N, 120) and done.any()
    # after an end, the next observation begins another episode
    last, first = rollout["next", "observation"][:, :-1][done], rollout["observation"][:, 1:][done]
    assert (last != first).any(dim=1).all()
    assert torch.equal(rollout["next", "observation"][:, :-1][~done], rollout["observation"][:, 1:][~done])
