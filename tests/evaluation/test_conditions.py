"""Conditions of evaluations: terminations, pushes, latency, gains and friction."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest
import torch

from jump_helpers import edit_coordinates, edit_episodes, ending_names, make_env
from jumper_warp.evaluation.conditions import Conditions, shared_robot
from jumper_warp.evaluation.jumps import JumpLog
from jumper_warp.evaluation.run import EvaluationArgs, EvaluationRun
from jumper_warp.kernels.jump.state import LANDED
from jumper_warp.policies.policy import save_policy
from jumper_warp.policies.spec import PolicyError
from jumper_warp.registry import make_task
from jumper_warp.robot.overlay import load_overlay
from jumper_warp.tasks.jump.evaluation import with_jump_terminations
from jumper_warp.tasks.randomization import PUSH_INTERVAL, PUSH_PROBABILITY, RandomizationCfg
from landing_helpers import still_policy

JUMP = make_task("horizontal-jump")
HELD = dataclasses.replace(
    JUMP,
    randomization=RandomizationCfg(
        push_interval=None, push_probability=1.0, resample_at="startup", push_force=(-7.0, 7.0)
    ),
)
"""Task whose training has one constant wrench per world, sampled once."""
pytestmark = pytest.mark.usefixtures("one_thread")


# ---------------------------------------------------------------- terminations


@pytest.mark.parametrize("name", ["horizontal-jump", "vertical-jump"])
def test_fall_takes_precedence_over_success(name):  # world 1 is too low
    env = make_env(2, task=with_jump_terminations(make_task(name)), auto_reset=False)
    env.evaluation_reset(np.zeros((2, 4)))
    edit_episodes(env, phase=LANDED, phase_steps=119)
    edit_coordinates(env, 1, q={2: 0.05})
    env.step(torch.zeros((2, 12)))
    assert ending_names(env) == ["success", "low_base"]


# ---------------------------------------------------------------- pushes


def test_evaluation_replaces_constant_wrench_by_intermittent_pushes_and_keeps_trained_intervals():
    drawn = Conditions(randomize=True).applied(HELD).randomization
    assert (drawn.push_interval, drawn.push_probability, drawn.resample_at) == (
        PUSH_INTERVAL,
        PUSH_PROBABILITY,
        "reset",
    )
    assert (drawn.push_in_flight, drawn.push_force) == (False, (-7.0, 7.0))
    trained = dataclasses.replace(HELD, randomization=RandomizationCfg(push_interval=(1.0, 2.0), push_probability=0.5))
    drawn = Conditions(randomize=True).applied(trained).randomization
    assert (drawn.push_interval, drawn.push_probability) == ((1.0, 2.0), 0.5)


@pytest.mark.parametrize("in_flight", [False, True])
def test_flying_robot_is_pushed_only_with_push_in_flight(in_flight):
    conditions = Conditions(randomize=True, push_in_flight=in_flight)
    task = conditions.applied(dataclasses.replace(HELD, randomization=RandomizationCfg(push_probability=1.0)))
    env = make_env(2, task=with_jump_terminations(task), randomize=True, auto_reset=False)
    env.evaluation_reset(np.zeros((2, 4)))
    edit_coordinates(env, 1, q={2: 1.0})  # [m] world 1 flies
    for _ in range(2):  # before the first step no paw has been in contact
        push = env.parameters.push.numpy().copy()
        env.step(torch.zeros((2, 12)))
    wrench = env.sim.state.body_f.numpy().reshape(2, 21, 6)[:, 0]
    assert push.any(axis=1).all()
    np.testing.assert_array_equal(wrench, push * [[1.0], [float(in_flight)]])


def test_conditions_keep_randomization_of_walking():
    walking = make_task("velocity-flat")
    assert Conditions(randomize=True).applied(walking).randomization == walking.randomization


# ---------------------------------------------------------------- latency, gains, friction


def test_nominal_conditions_change_only_margins():
    assert HELD.self_collision_margin > 0.0
    wary = dataclasses.replace(HELD, obstacle_margin=0.01)
    assert Conditions().applied(wary) == dataclasses.replace(HELD, self_collision_margin=0.0)


def test_conditions_change_only_the_fixed_parameters():
    conditions = Conditions(latency=8.0, gain_scale=(0.6, 1.0), friction=0.4)
    task = with_jump_terminations(JUMP)
    nominal = make_env(2, task=task, auto_reset=False)
    env = make_env(2, task=conditions.applied(task), randomize=conditions.sets_parameters, auto_reset=False)
    assert env.parameters.latency.numpy().tolist() == [4, 4]  # 8 ms are 3.84 physics steps
    motors, others = env.sim.motors, nominal.sim.motors
    np.testing.assert_allclose(motors.kp.numpy(), 0.6 * others.kp.numpy(), rtol=1e-6)
    for name in ("kd", "no_load_speed", "cutoff_speed", "saturation", "offset"):
        np.testing.assert_array_equal(getattr(motors, name).numpy(), getattr(others, name).numpy())
    table, before = (each.sim.dynamics.robot.table.numpy() for each in (env, nominal))
    changed = (table != before).any(axis=1)
    assert changed.sum() == 8 and (table[changed] == np.float32(0.4)).all()  # static, dynamic friction of four legs
    assert not env.parameters.push.numpy().any()


def test_policies_of_different_robot_folders_are_not_combined():
    robots = {name: load_overlay(Path(name)) for name in ("heavy", "small_direct_drive")}
    with pytest.raises(PolicyError, match="heavy and small_direct_drive were trained with different robots"):
        shared_robot(robots, Conditions())


def test_sensor_offset_is_drawn_for_every_robot_and_motor_within_its_size():
    conditions = Conditions(sensor_offset=4.0)
    env = make_env(16, task=conditions.applied(JUMP), randomize=conditions.sets_parameters, auto_reset=False)
    offset = np.degrees(env.sim.motors.offset.numpy())
    assert len(np.unique(offset)) == offset.size == 16 * 12
    assert 3.5 < np.abs(offset).max() <= 4.0 and abs(offset.mean()) < 1.0
    drawn = Conditions(randomize=True, sensor_offset=4.0).applied(JUMP).randomization
    assert (drawn.joint_offset, drawn.gains) == ((-4.0, 4.0), RandomizationCfg().gains)


def test_fixing_a_parameter_at_its_nominal_value_is_bitwise_neutral():
    conditions, task = Conditions(latency=0.0), with_jump_terminations(JUMP)
    pair = [make_env(2, task=task), make_env(2, task=conditions.applied(task), randomize=conditions.sets_parameters)]
    for env in pair:
        env.auto_reset = False
        env.evaluation_reset(np.array([[0.5, 0.0, 0.0, 30.0]] * 2))
        for step in range(20):
            env.step(torch.full((2, 12), 0.02 * step))
    assert torch.equal(pair[0].obs, pair[1].obs)
    np.testing.assert_array_equal(*(env.sim.dynamics.robot.table.numpy() for env in pair))
    np.testing.assert_array_equal(*(env.sim.joint_q() for env in pair))


def test_randomised_conditions_keep_fixed_parameters():
    drawn = Conditions(randomize=True, gain_scale=(0.6, 1.0), latency=50.0).applied(JUMP).randomization
    assert (drawn.gains, drawn.damping_gains, drawn.latency) == ((0.6, 0.6), (1.0, 1.0), (50.0, 50.0))
    assert drawn.base_mass == RandomizationCfg().base_mass


def test_run_reports_simulated_latency_in_metrics_and_title(tmp_path):
    save_policy(tmp_path / "still", still_policy("horizontal-jump"))
    args = EvaluationArgs(policy=str(tmp_path / "still"), latency=40.0, num_recorded=0, out=tmp_path, device="cpu")
    run = EvaluationRun.from_args("test", args)
    env = run.env(2)
    log = JumpLog(np.array([[[0.5, 0.0]]] * 2), env.task.termination_names)
    run.run_episodes(env, log)
    values = run.report({}, {})
    assert (values["latency_requested_ms"], values["latency"]) == (40.0, "39.6 ms (19 physics steps)")
    assert values["latency_ms"] == pytest.approx(1000.0 * 19 / 480)
    assert run.title == "SolverJumper, nominal, latency 39.6 ms (19 physics steps)"
