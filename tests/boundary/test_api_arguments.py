"""Arguments of another kind raise InputError, and name what is wrong."""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path

import numpy as np
import pytest
import torch
import warp as wp

from hold_height import hold_height
from jumper_warp import Env, Recipe, Simulation, SolverJumper, build_model, load_policy, make_task, train
from jumper_warp.deploy.policy import DeployedPolicy
from jumper_warp.diff.rollout import Rollout
from jumper_warp.diff.torch_rollout import simulate
from jumper_warp.envs.gymnasium import GymVectorEnv
from jumper_warp.envs.rsl_rl import RslRlVecEnv
from jumper_warp.evaluation.conditions import Conditions
from jumper_warp.identification.motions import RecordedMotion
from jumper_warp.policies.catalog import ONNX, add_files
from jumper_warp.policies.policy import save_policy
from jumper_warp.registry import register_task
from jumper_warp.rl.cfg import PpoCfg, TrainCfg
from jumper_warp.robot.grounds import BlockCfg, platform, uneven
from jumper_warp.robot.motors import LimitsCfg, vertical_jump_filter
from jumper_warp.robot.overlay import RobotOverlay
from jumper_warp.robot.terrain import TerrainCfg
from jumper_warp.sim.dynamics import WorldRange
from jumper_warp.tasks.cfg import ObservationsCfg
from jumper_warp.tasks.evaluation import EpisodeMetric
from jumper_warp.utils.arrays import real_array
from jumper_warp.utils.assets import POLICIES
from jumper_warp.utils.errors import InputError
from jumper_warp.viz.recorder import Recorder

POLICY = POLICIES / "vertical_jump"
ZEROS = np.zeros(12)
SQUARE = np.zeros((12, 12))
TIMES = np.arange(12.0)
HOLD = hold_height()
BLIND = dataclasses.replace(make_task("attitude"), observations=ObservationsCfg((), ()))  # a task without observation


@pytest.fixture(scope="module")
def env():
    return Env(make_task("vertical-jump"), 1, device="cpu")


@pytest.fixture(scope="module")
def model():
    return build_model(1)


def recorded(model):
    """Return a recorder with two frames of a model of one world."""
    recorder = Recorder(model)
    recorder.record(0.0, model.body_q)
    recorder.record(0.1, model.body_q)
    return recorder


def with_block():
    """Return a solver of one world with a block."""
    return SolverJumper(build_model(1), block=BlockCfg((0.9, 0.0)))


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda env, model: RslRlVecEnv(env, metrics_every=0), "metrics_every"),
        (lambda env, model: env.stages(WorldRange(0, 10)), "worlds"),
        (lambda env, model: env.sim.advance(1, env.sim.target, worlds=WorldRange(1, 1)), "worlds"),
        (lambda env, model: env.sim.advance(1, env.sim.target, delay=wp.zeros(1, dtype=int, device="cpu")), "delay"),
        (lambda env, model: build_model(1, friction=True), "friction"),
        (lambda env, model: build_model(1, gravity=True), "gravity"),
        (lambda env, model: SolverJumper(model, max_sweeps=math.nan), "max_sweeps"),
        (lambda env, model: Rollout(model, every=True), "every"),
        (lambda env, model: EpisodeMetric("hops_m", "phase", "median"), "statistic"),
        (lambda env, model: train(Recipe(BLIND)), "no observation"),
        (lambda env, model: TerrainCfg(cell=1.0e-9), "10000 cells"),
        (lambda env, model: BlockCfg((0.9, 0.0), mass=math.inf), "block mass"),
        (lambda env, model: BlockCfg((0.9, 0.0), friction=math.inf), "block friction"),
        (lambda env, model: platform(0.2, size=1e9), "size"),
        (lambda env, model: platform(0.2, cell=1e-9), "cell"),
        (lambda env, model: uneven(length=1e9), "length"),
        (lambda env, model: RobotOverlay({"base_mass": 8}), "base_mass"),
        (lambda env, model: simulate(Rollout(model), *map(torch.zeros, ((1, 12), 19, 18)), trusted="no"), "trusted"),
        (lambda env, model: Recorder(model).record(0.0, model.body_q, commands=ZEROS), "commands"),
        (lambda env, model: recorded(model).recording(goals=np.zeros((5, 1, 3))), "goals"),
        (lambda env, model: recorded(model).save_picture("x.png", true_scale="no"), "true_scale"),
        (lambda env, model: LimitsCfg(False, 90.0), "angle lower"),
        (lambda env, model: dataclasses.replace(vertical_jump_filter(), horizon=True), "filter horizon"),
        (lambda env, model: with_block().place_blocks((math.nan, 0.0)), "center"),
        (lambda env, model: RecordedMotion("x", TIMES, np.zeros((12, 12), bool)), "motion x: target"),
        (lambda env, model: RecordedMotion("x", TIMES, SQUARE, SQUARE + 1j), "motion x: angle"),
        (lambda env, model: RecordedMotion("x", TIMES * 1.0e9, SQUARE, SQUARE), "time rises by 1e\\+09 s a row"),
        (lambda env, model: DeployedPolicy(POLICY / ONNX).act(np.ones(147, dtype=bool)), "observation must be numbers"),
        (lambda env, model: Simulation(2, keep_momentum="no"), "keep_momentum must be True or False"),
        (lambda env, model: Simulation(2).reset([1, 0]), "mask must be bool"),
        (lambda env, model: real_array(np.ma.masked_array(ZEROS, mask=ZEROS == 0.0), "values"), "masked"),
        (lambda env, model: DeployedPolicy(POLICY / ONNX).filter_targets(ZEROS, np.full(12, np.nan), ZEROS), "angle"),
        (lambda env, model: PpoCfg(epochs=1.5), "ppo epochs must be int"),
        (lambda env, model: train("vertical-jump"), "needs a Recipe"),
        (lambda env, model: TrainCfg(task="../outside"), "task, run_name and tags"),
        (lambda env, model: TrainCfg("vertical-jump", stop_on_nan="no"), "stop_on_nan must be bool"),
        (lambda env, model: register_task("a/b", make_task), "register_task needs names"),
        (lambda env, model: Env(HOLD, True), "num_envs must be a whole number"),
        (lambda env, model: Env(HOLD, 2, randomize=0), "randomize must be True or False, got 0"),
        (lambda env, model: GymVectorEnv(env, tensors="no"), "tensors must be True or False, got 'no'"),
        (lambda env, model: Conditions(randomize="no"), "randomize must be True or False"),
        (lambda env, model: HOLD.rewards[0].replace(scale_by_dt="no"), "near_goal: scale_by_dt must be True"),
        (lambda env, model: HOLD.terminations[0].replace(success="no"), "success must be True or False"),
        (lambda env, model: make_task("vertical-jump", "heavy"), "robot must be"),
        (lambda env, model: env.load_state_dict({"done": np.zeros(2)}), "saved done must be Tensor"),
    ],
)  # fmt: skip
def test_an_argument_of_another_type_or_out_of_range_is_named(call, message, env, model):
    with pytest.raises(InputError, match=message):
        call(env, model)


def test_a_rollout_takes_tensors_with_gradient():
    rollout = Rollout(build_model(1))
    q, qd = rollout.standing()
    expected = rollout.run(ZEROS[None], q, qd).q.numpy()
    tensor = torch.tensor(q, requires_grad=True)
    np.testing.assert_array_equal(rollout.run(ZEROS[None], tensor, qd).q.numpy(), expected)


@pytest.mark.parametrize("name", ["../outside.txt", "", "a\0b", "manifest.json"])
def test_a_policy_holds_files_of_its_folder_only(name, tmp_path: Path):
    folder = save_policy(tmp_path / "policy", load_policy("vertical_jump"))
    before = sorted(tmp_path.rglob("*"))
    with pytest.raises(InputError, match="cannot hold"):
        add_files(folder, {name: b""})
    with pytest.raises(InputError, match="cannot hold"):
        save_policy(tmp_path / "other", load_policy("vertical_jump"), files={name: b""})
    assert sorted(tmp_path.rglob("*")) == before


def test_a_device_is_not_replaced_by_a_file():
    with pytest.raises(OSError, match="not a regular file"):
        RobotOverlay({}).save(Path("/dev/null"))
    assert Path("/dev/null").is_char_device()


def test_an_overlay_of_arrays_equals_one_of_tuples_and_can_be_saved(tmp_path):
    overlay = RobotOverlay({"kp": np.full(12, 1.25, np.float32)}, {"gains": np.array([0.9, 1.1])})
    assert overlay.to_json() == RobotOverlay({"kp": (1.25,) * 12}, {"gains": (0.9, 1.1)}).to_json()
    overlay.save(tmp_path / "overlay.json")
