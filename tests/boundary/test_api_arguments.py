"""Arguments of another kind raise InputError, and name what is wrong."""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path

import newton
import numpy as np
import pytest
import torch
import warp as wp

from hold_height import hold_height
from jumper_warp import Env, Recipe, Simulation, SolverJumper, build_model, load_policy, make_task, train
from jumper_warp.deploy.policy import DeployedPolicy, JumpCommand
from jumper_warp.diff.rollout import Rollout
from jumper_warp.diff.torch_rollout import simulate
from jumper_warp.envs.gymnasium import GymEnv, GymVectorEnv
from jumper_warp.envs.rsl_rl import RslRlVecEnv
from jumper_warp.envs.sb3 import Sb3VecEnv
from jumper_warp.evaluation.conditions import Conditions
from jumper_warp.identification.motions import RecordedMotion, load_motions
from jumper_warp.policies.catalog import ONNX, add_files, read_files, summarise
from jumper_warp.policies.policy import save_policy
from jumper_warp.registry import register_task
from jumper_warp.rl.cfg import PpoCfg, TrainCfg
from jumper_warp.robot.description import DEFAULT_DESCRIPTION, load_description
from jumper_warp.robot.export import export_robot
from jumper_warp.robot.grounds import BlockCfg, platform, uneven
from jumper_warp.robot.motors import LimitsCfg, jumping_motors, vertical_jump_filter, walking_motors
from jumper_warp.robot.overlay import RobotOverlay
from jumper_warp.robot.terrain import TerrainCfg
from jumper_warp.sim.dynamics import WorldRange
from jumper_warp.tasks.cfg import ObservationsCfg
from jumper_warp.tasks.evaluation import EpisodeMetric
from jumper_warp.tasks.terms import StateMetric
from jumper_warp.utils.arrays import real_array
from jumper_warp.utils.assets import POLICIES
from jumper_warp.utils.errors import InputError
from jumper_warp.utils.output import output_dir, write_metrics
from jumper_warp.viz.film import check_film, write_film
from jumper_warp.viz.picture import write_picture
from jumper_warp.viz.recorder import Recorder
from jumper_warp.viz.recording import load_npz
from jumper_warp.viz.rerun import write_rrd

POLICY = POLICIES / "vertical_jump"
ZEROS = np.zeros(12)
SQUARE = np.zeros((12, 12))
TIMES = np.arange(12.0)
HEIGHT = make_task("vertical-jump").observations.actor[0]
HOLD = hold_height()
COMMAND = make_task("vertical-jump").command
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


def contacts_of(model):
    return newton.CollisionPipeline(model).contacts()


@pytest.mark.parametrize("other", [None, ZEROS])
@pytest.mark.parametrize(
    ("make", "name"),
    [
        (GymVectorEnv, "env"),
        (GymEnv, "env"),
        (Sb3VecEnv, "envs"),
        (RslRlVecEnv, "env"),
        (Rollout, "model"),
        (SolverJumper, "model"),
        (Recorder, "model"),
        (lambda other: simulate(other, *map(torch.zeros, ((1, 12), 19, 18))), "rollout"),
    ],
)
def test_another_object_in_place_of_an_environment_or_a_model_is_refused(make, name, other):
    with pytest.raises(InputError, match=f"^{name} must be "):
        make(other)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda env, model: RslRlVecEnv(env, metrics_every=0), "metrics_every"),
        (lambda env, model: RslRlVecEnv(env, max_episode_length="x"), "max_episode_length"),
        (lambda env, model: env.stages(WorldRange(0, 10)), "worlds"),
        (lambda env, model: env.sim.advance(1, env.sim.target, worlds=WorldRange(1, 1)), "worlds"),
        (lambda env, model: env.sim.advance(1, env.sim.target, delay=wp.zeros(1, dtype=int, device="cpu")), "delay"),
        (lambda env, model: env.task_arrays(1), "skill"),
        (lambda env, model: env.mirror("x"), "mirror"),
        (lambda env, model: GymVectorEnv(env, render_size=3), "render_size"),
        (lambda env, model: build_model(1, robot=3), "robot"),
        (lambda env, model: build_model(1, description=3), "description"),
        (lambda env, model: build_model(1, extras=3), "extras"),
        (lambda env, model: build_model(1, friction=True), "friction"),
        (lambda env, model: build_model(1, gravity=True), "gravity"),
        (lambda env, model: SolverJumper(model, block=3), "block"),
        (lambda env, model: SolverJumper(model, description=3), "description"),
        (lambda env, model: SolverJumper(model, max_sweeps=math.nan), "max_sweeps"),
        (lambda env, model: SolverJumper(model, dynamics=3), "dynamics"),
        (lambda env, model: Rollout(model, every=True), "every"),
        (lambda env, model: Rollout(model, tolerance=True), "tolerance"),
        (lambda env, model: EpisodeMetric("hops_m", "phase", "median"), "statistic"),
        (lambda env, model: train(Recipe(BLIND)), "no observation"),
        (lambda env, model: TerrainCfg(cell=1.0e-9), "10000 cells"),
        (lambda env, model: register_task("x", lambda: None, about=3), "about"),
        (lambda env, model: register_task("x", lambda: None, ppo={}), "ppo"),
        (lambda env, model: register_task("x", lambda: None, aliases="abc"), "aliases"),
        (lambda env, model: register_task("x", lambda: None, presets={"a": 3}), "preset 'a'"),
        (lambda env, model: BlockCfg((0.9, 0.0), height="x"), "block height"),
        (lambda env, model: BlockCfg((0.9, 0.0), mass=math.inf), "block mass"),
        (lambda env, model: BlockCfg((0.9, 0.0), friction=math.inf), "block friction"),
        (lambda env, model: BlockCfg((0.9,)), "block center"),
        (lambda env, model: BlockCfg((0.9, 0.0), half=0.4), "block half"),
        (lambda env, model: platform("x"), "height"),
        (lambda env, model: platform(0.2, edge="x"), "edge"),
        (lambda env, model: platform(0.2, size=1e9), "size"),
        (lambda env, model: platform(0.2, cell=1e-9), "cell"),
        (lambda env, model: uneven("x"), "amplitude"),
        (lambda env, model: uneven(length=1e9), "length"),
        (lambda env, model: uneven(flat_radius=None), "flat_radius"),
        (lambda env, model: uneven(seed="x"), "seed"),
        (lambda env, model: TerrainCfg(rows="x"), "rows"),
        (lambda env, model: TerrainCfg(kinds=3), "kinds"),
        (lambda env, model: TerrainCfg(step=0.1), "step"),
        (lambda env, model: RobotOverlay({"base_mass": 8}), "base_mass"),
        (lambda env, model: RobotOverlay(3), "values"),
        (lambda env, model: HEIGHT.replace(mirror=3), "mirror"),
        (lambda env, model: HEIGHT.replace(name=3), "name"),
        (lambda env, model: StateMetric(3, "level"), "name"),
        (lambda env, model: simulate(Rollout(model), *map(torch.zeros, ((1, 12), 19, 18)), trusted="no"), "trusted"),
        (lambda env, model: Recorder(model, labels=3), "labels"),
        (lambda env, model: Recorder(model, spacing=math.nan), "spacing"),
        (lambda env, model: Recorder(model, worlds=3), "worlds"),
        (lambda env, model: Recorder(model, notes=3), "notes"),
        (lambda env, model: Recorder(model).record("x", model.body_q), "time"),
        (lambda env, model: Recorder(model).record(0.0, None), "body_poses"),
        (lambda env, model: Recorder(model).record(0.0, model.body_q, "x"), "series"),
        (lambda env, model: Recorder(model).record(0.0, model.body_q, states="x"), "states"),
        (lambda env, model: env.sim.advance(None, env.sim.target), "substeps"),
        (lambda env, model: env.sim.advance(1, None), "target"),
        (lambda env, model: SolverJumper(model).update_contacts(None, model.state()), "contacts"),
        (lambda env, model: SolverJumper(model).update_contacts(contacts_of(model), "x"), "state"),
        (lambda env, model: save_policy(Path("none"), "vertical_jump"), "policy"),
        (lambda env, model: jumping_motors("x"), "torque"),
        (lambda env, model: walking_motors(None), "torque"),
        (lambda env, model: Conditions(latency="x"), "latency"),
        (lambda env, model: Conditions(gain_scale=1.0), "gain_scale"),
        (lambda env, model: Conditions(sensor_offset="x"), "sensor_offset"),
        (lambda env, model: dataclasses.replace(COMMAND, labels=3), "labels"),
        (lambda env, model: dataclasses.replace(COMMAND, least=0.0), "least"),
        (lambda env, model: dataclasses.replace(COMMAND, optional="x"), "optional"),
        (lambda env, model: write_film("x", Path("x.gif")), "recording"),
        (lambda env, model: write_picture("x", Path("x.png")), "recording"),
        (lambda env, model: write_rrd("x", Path("x.rrd")), "recording"),
        (lambda env, model: check_film(Path("x.gif"), 3, 10.0, 1.0), "size"),
        (lambda env, model: check_film(Path("x.gif"), (64, 64), "x", 1.0), "fps"),
        (lambda env, model: check_film(Path("x.gif"), (64, 64), 10.0, None), "speed"),
        (lambda env, model: Recorder(model).record(0.0, model.body_q, commands=ZEROS), "commands"),
        (lambda env, model: recorded(model).recording(goals=ZEROS), "goals"),
        (lambda env, model: recorded(model).recording(goals=np.zeros((5, 1, 3))), "goals"),
        (lambda env, model: recorded(model).recording(goals=np.zeros((1, 1, 2))), "goals"),
        (lambda env, model: recorded(model).recording(heights=ZEROS), "heights"),
        (lambda env, model: recorded(model).save_picture("x.png", true_scale="no"), "true_scale"),
        (lambda env, model: recorded(model).save_picture("x.png", width=300.5), "width"),
        (lambda env, model: recorded(model).save_picture("x.png", title=3), "title"),
        (lambda env, model: recorded(model).save_picture("x.png", eye=(1.0, 2.0)), "eye"),
        (lambda env, model: recorded(model).save_picture("x.png", eye=(math.nan, 0.0, 0.0)), "eye"),
        (lambda env, model: recorded(model).save_picture("x.png", field_of_view="x"), "field_of_view"),
        (lambda env, model: write_film(recorded(model).recording(), "x.gif", eye=(0.0, math.nan, 1.0)), "eye"),
        (lambda env, model: write_film(recorded(model).recording(), "x.gif", field_of_view=-5.0), "field_of_view"),
        (lambda env, model: check_film("x.gif", (64, 64, 64), 10.0, 1.0), "size"),
        (lambda env, model: export_robot("xml", Path("none")), "kind must be mjcf or urdf or usd"),
        (lambda env, model: LimitsCfg(False, 90.0), "angle lower"),
        (lambda env, model: LimitsCfg("0", 90.0), "angle lower"),
        (lambda env, model: dataclasses.replace(vertical_jump_filter(), sum=(0.0, 90.0)), "filter sum"),
        (lambda env, model: dataclasses.replace(vertical_jump_filter(), horizon=True), "filter horizon"),
        (lambda env, model: with_block().place_blocks((math.nan, 0.0)), "center"),
        (lambda env, model: with_block().place_blocks("x"), "center"),
        (lambda env, model: RecordedMotion("x", TIMES, np.zeros((12, 12), bool)), "motion x: target"),
        (lambda env, model: RecordedMotion("x", TIMES, "targets"), "motion x: target"),
        (lambda env, model: RecordedMotion("x", TIMES, SQUARE, SQUARE + 1j), "motion x: angle"),
        (lambda env, model: RecordedMotion("x", TIMES * 1.0e9, SQUARE, SQUARE), "time rises by 1e\\+09 s a row"),
        (lambda env, model: DeployedPolicy(POLICY / ONNX).act(np.ones(147, dtype=bool)), "observation must be numbers"),
        (lambda env, model: GymVectorEnv(GymVectorEnv(env)), "env must be Env"),
        (lambda env, model: SolverJumper(model).step(3, model.state(), None, None, 0.002), r"state_in\.joint_q must"),
        (lambda env, model: make_task(1), "name must be a text"),
        (lambda env, model: load_policy("vertical_jump", "foo"), "no device"),
        (lambda env, model: Simulation(1, motors=[1]), "motors"),
        (lambda env, model: Simulation(1, command_filter=[1]), "command_filter"),
        (lambda env, model: Simulation(1, dt="x"), "dt"),
        (lambda env, model: Simulation(2, keep_momentum="no"), "keep_momentum must be True or False"),
        (lambda env, model: Simulation(2).reset([1, 0]), "mask must be bool"),
        (lambda env, model: Rollout(model, motors=[1]), "motors"),
        (lambda env, model: Rollout(model, double="no"), "double must be True or False"),
        (lambda env, model: Rollout(model).run("x", *Rollout(model).standing()), "targets"),
        (lambda env, model: Rollout(model).set_geometry([["a"] * 10] * 4), "geometry"),
        (lambda env, model: real_array(np.ma.masked_array(ZEROS, mask=ZEROS == 0.0), "values"), "masked"),
        (lambda env, model: DeployedPolicy(POLICY / ONNX).act(np.full(147, np.nan)), "observation"),
        (lambda env, model: DeployedPolicy(POLICY / ONNX).filter_targets("x", ZEROS, ZEROS), "target"),
        (lambda env, model: DeployedPolicy(POLICY / ONNX).filter_targets(ZEROS, np.full(12, np.nan), ZEROS), "angle"),
        (lambda env, model: DeployedPolicy(POLICY / ONNX).filter_targets(ZEROS, ZEROS, ZEROS + 1j), "rate"),
        (lambda env, model: JumpCommand().update(10**400, 4), "vertical_velocity must be"),
        (lambda env, model: JumpCommand(math.nan), "takeoff_speed must be"),
        (lambda env, model: JumpCommand().update(0.0, 1.5), "paws_down"),
        (lambda env, model: PpoCfg(gamma=None), "ppo gamma"),
        (lambda env, model: PpoCfg(epochs=1.5), "ppo epochs must be int"),
        (lambda env, model: PpoCfg(hidden="1e-4"), "ppo hidden"),
        (lambda env, model: dataclasses.replace(jumping_motors().lateral, kp=None), "motor kp"),
        (lambda env, model: Recipe("vertical-jump"), "recipe task"),
        (lambda env, model: train("vertical-jump"), "needs a Recipe"),
        (lambda env, model: TrainCfg(task="../outside"), "task, run_name and tags"),
        (lambda env, model: TrainCfg("vertical-jump", stop_on_nan="no"), "stop_on_nan must be bool"),
        (lambda env, model: register_task("mine", 3), "register_task needs names"),
        (lambda env, model: register_task("a/b", make_task), "register_task needs names"),
        (lambda env, model: register_task("mine", make_task, replace="no"), "replace must be True or False"),
        (lambda env, model: load_motions(["/"]), "no npz or csv file"),
        (lambda env, model: (env.reset(), env.use_reset_mask()), "before the first reset"),
        (lambda env, model: Env(HOLD, True), "num_envs must be a whole number"),
        (lambda env, model: Env(HOLD, 2, randomize=0), "randomize must be True or False, got 0"),
        (lambda env, model: Env(HOLD, 2, block=3), "block must be BlockCfg or None, got 3"),
        (lambda env, model: Env(HOLD, 2, handovers=[3]), r"handovers must be a sequence of Handover, got \[3\]"),
        (lambda env, model: GymVectorEnv(env, tensors="no"), "tensors must be True or False, got 'no'"),
        (lambda env, model: Conditions(randomize="no"), "randomize must be True or False"),
        (lambda env, model: HOLD.rewards[0].replace(scale_by_dt="no"), "near_goal: scale_by_dt must be True"),
        (lambda env, model: HOLD.terminations[0].replace(success="no"), "success must be True or False"),
        (lambda env, model: make_task("vertical-jump", "heavy"), "robot must be"),
        (lambda env, model: Recipe.of("vertical-jump", "heavy"), "robot must be"),
        (lambda env, model: Rollout(model, description="heavy"), "description must be"),
        (lambda env, model: Rollout(model).backward(None), "trajectory must be"),
        (lambda env, model: env.load_state_dict(None), "state must be"),
        (lambda env, model: env.load_state_dict({"done": np.zeros(2)}), "saved done must be Tensor"),
        (lambda env, model: GymVectorEnv(env).reset(options="x"), "options must be"),
        (lambda env, model: dataclasses.replace(make_task("vertical-jump").command, optional=-1), "a command has"),
        (lambda env, model: env.set(None, 1.0), "the name of a number must be text"),
        (lambda env, model: env.set("weight", 1.0), "names are like rewards.jump_height.weight"),
        (lambda env, model: env.set("rewards.orientation.depth", 1.0), "no number 'depth' of a rewards term"),
        (lambda env, model: env.set("rewards.jump_height.weight", 1.0, "0"), "skill must be an index below 1"),
    ],
)  # fmt: skip
def test_an_argument_of_another_type_or_out_of_range_is_named(call, message, env, model):
    with pytest.raises(InputError, match=message):
        call(env, model)


def test_a_path_may_be_a_text(tmp_path, model):
    folder = str(save_policy(f"{tmp_path}/policy", load_policy("vertical_jump")))
    add_files(folder, {"notes.txt": b"text"})
    assert read_files(folder)["notes.txt"] == b"text"
    assert summarise(folder) == summarise(Path(folder))
    assert load_description(str(DEFAULT_DESCRIPTION)).urdf == load_description().urdf
    assert export_robot("urdf", f"{tmp_path}/robot").is_file()
    check_film("x.gif", (64, 64), 10.0, 1.0)
    recorder = recorded(model)
    assert load_npz(str(recorder.save_npz(f"{tmp_path}/x.npz"))).worlds == (0,)


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


def test_paths_are_texts_too(tmp_path: Path, model):
    recorder = Recorder(model)
    recorder.record(0.0, model.body_q)
    assert write_rrd(recorder.recording(), str(tmp_path / "a.rrd")).is_file()
    folder = output_dir("results", str(tmp_path / "out"))
    assert write_metrics(str(folder), {"height_m": 0.5}).path.is_file()


def test_a_recording_without_series_is_written(tmp_path: Path):
    model = build_model(1)
    recorder = Recorder(model)
    recorder.record(0.0, model.state().body_q)
    assert load_npz(recorder.save_npz(tmp_path / "recording.npz")).series == {}


def test_a_device_is_not_replaced_by_a_file():
    with pytest.raises(OSError, match="not a regular file"):
        RobotOverlay({}).save(Path("/dev/null"))
    assert Path("/dev/null").is_char_device()


def test_an_overlay_of_arrays_equals_one_of_tuples_and_can_be_saved(tmp_path):
    overlay = RobotOverlay({"kp": np.full(12, 1.25, np.float32)}, {"gains": np.array([0.9, 1.1])})
    assert overlay.to_json() == RobotOverlay({"kp": (1.25,) * 12}, {"gains": (0.9, 1.1)}).to_json()
    overlay.save(tmp_path / "overlay.json")
