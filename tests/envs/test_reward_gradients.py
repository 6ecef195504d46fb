import torch

from jumper_warp.policies.policy import Policy
from reward_gradients import compare


def test_gradients_of_returns_match_differences_in_double_precision(one_thread):
    torch.manual_seed(0)
    windows = compare(Policy.load("vertical_jump"), num_envs=10, steps=5, directions=4)
    assert (windows["cosine"] >= 0.99).mean() >= 0.8
    assert windows["contact"].mean() >= 0.4
