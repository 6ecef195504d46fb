"""Arguments of other types: integers of NumPy and torch are counts, and texts are no flags."""

import copy
import json
import pickle

import gymnasium
import numpy as np
import pytest
import torch

import jumper_warp.gym  # registers the tasks
from hold_height import hold_height, near_goal
from jumper_warp.envs.env import Env
from jumper_warp.envs.gymnasium import GymVectorEnv
from jumper_warp.evaluation.conditions import Conditions
from jumper_warp.rl.cfg import TrainCfg
from jumper_warp.sim.simulation import Simulation
from jumper_warp.tasks.terms import RewardTerm, TerminationTerm
from jumper_warp.utils.errors import InputError


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


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"num_envs": True}, "num_envs must be a whole number"),
        ({"num_envs": np.float64(4.0)}, "num_envs must be a whole number"),
        ({"randomize": 0}, "randomize must be True or False, got 0"),
        ({"noise": "no"}, "noise must be True or False, got 'no'"),
        ({"auto_reset": None}, "auto_reset must be True or False"),
        ({"visuals": 1.0}, "visuals must be True or False"),
        ({"block": 3}, "block must be BlockCfg or None, got 3"),
        ({"handovers": [3]}, r"handovers must be a sequence of Handover, got \[3\]"),
    ],
)
def test_refuses_another_type_of_an_argument(arguments, message):
    with pytest.raises(InputError, match=message):
        Env(hold_height(), **({"num_envs": 2, "device": "cpu"} | arguments))


@pytest.mark.parametrize(
    ("make", "name"),
    [
        (lambda flag: Simulation(2, device="cpu", keep_momentum=flag), "keep_momentum"),
        (lambda flag: GymVectorEnv(Env(hold_height(), 2, device="cpu"), tensors=flag), "tensors"),
        (lambda flag: RewardTerm(near_goal, 1.0, width=1.0, scale_by_dt=flag), "RewardTerm near_goal: scale_by_dt"),
        (lambda flag: TrainCfg("vertical-jump", stop_on_nan=flag), "stop_on_nan"),
        (lambda flag: Conditions(randomize=flag), "randomize"),
        (lambda flag: hold_height().terminations[0].replace(success=flag), "success"),
    ],
)
def test_refuses_a_text_as_a_flag(make, name):
    with pytest.raises(InputError, match=f"{name} must be True or False, got 'no'"):
        make("no")


def test_a_bool_of_numpy_is_a_flag():
    assert Env(hold_height(), 2, device="cpu", randomize=np.bool_(False)).config()["randomize"] is False
    assert TerminationTerm(hold_height().terminations[0].func, success=np.bool_(True)).options["success"] is True


def test_refuses_another_type_of_a_number_or_skill_to_set():
    env = Env(hold_height(), 2, device="cpu")
    for name in (None, 5, ("rewards",)):
        with pytest.raises(InputError, match="the name of a number must be text"):
            env.set(name, 1.0)
    for skill in (None, "0", 0.0, 1):
        with pytest.raises(InputError, match="skill must be an index below 1"):
            env.set("rewards.near_goal.weight", 1.0, skill)


def test_a_snapshot_can_be_neither_copied_nor_pickled():
    env = Env(hold_height(), 2, device="cpu")
    env.reset()
    for save in (pickle.dumps, copy.deepcopy):
        with pytest.raises(TypeError, match="Snapshot can be neither copied nor pickled"):
            save(env.snapshot())
