"""Arguments of other types: integers of NumPy and torch are counts, and texts are no flags."""

import copy
import json
import pickle

import gymnasium
import numpy as np
import pytest
import torch

import jumper_warp.gym  # registers the tasks
from hold_height import hold_height
from jumper_warp.diff.rollout import Rollout
from jumper_warp.envs.env import Env
from jumper_warp.envs.gymnasium import GymVectorEnv
from jumper_warp.rl.cfg import TrainCfg
from jumper_warp.sim.simulation import Simulation


def test_integers_of_numpy_and_torch_are_counts():
    env = Env(hold_height(), np.int64(4), seed=np.uint8(3), threads=np.int32(1), refine=torch.tensor(1), device="cpu")
    env.reset(seed=np.int64(3))
    obs = env.step(torch.zeros(4, 12)).obs["actor"].clone()
    json.dumps(env.config())
    other = Env(hold_height(), 4, seed=3, device="cpu")
    other.reset()
    assert torch.equal(other.step(torch.zeros(4, 12)).obs["actor"], obs)
    envs = gymnasium.make_vec(jumper_warp.gym.env_id("vertical-jump"), np.int64(2), device="cpu")
    assert envs.reset()[0].shape[0] == 2
    Simulation(np.int64(2), substeps=np.int64(4), visuals=False, device="cpu").step()
    assert type(TrainCfg("vertical-jump", num_envs=np.int64(8)).num_envs) is int


def test_what_holds_arrays_of_a_device_can_be_neither_copied_nor_pickled():
    env = Env(hold_height(), 2, device="cpu")
    env.reset()
    for each in (env, env.snapshot(), GymVectorEnv(env), env.sim, Rollout(env.sim.model)):
        for save in (pickle.dumps, copy.deepcopy):
            with pytest.raises(TypeError, match="can be neither copied nor pickled"):
                save(each)
