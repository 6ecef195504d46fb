import importlib
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from experiments import (
    benchmark_solver,
    benchmark_training,
    demo,
    gradient_cost,
    leg_springs,
    mujoco_policy,
    rescue,
    solver_accuracy,
    teacher,
    template,
    walk_jump_walk,
)  # fmt: skip
from jumper_warp.cli.flags import parse
from jumper_warp.evaluation.conditions import Conditions, env_of_recipe
from jumper_warp.evaluation.jump_metrics import HeightFlags
from jumper_warp.evaluation.jumps import JumpLog
from jumper_warp.evaluation.limits import limit_metrics
from jumper_warp.evaluation.log import run_evaluation, within
from jumper_warp.evaluation.sweeps import HeightSweep
from jumper_warp.recipe import Recipe
from jumper_warp.registry import make_task
from jumper_warp.rl.cfg import PpoCfg, TrainCfg
from jumper_warp.tasks.jump.evaluation import with_jump_terminations
from jumper_warp.training import train
from jumper_warp.utils.output import read_values
from landing_helpers import OPEN_LOOP_APEX, OpenLoopPolicy, still_policy
from metric_helpers import saved_metrics, values

SWEEP_ENDS = ("success", "diverged", "low_base", "tilted", "collided", "no_jump", "too_long")
pytestmark = pytest.mark.usefixtures("one_thread")

SCRIPTS = [file.stem for file in Path(rescue.__file__).parent.glob("*.py") if "(main, Args)" in file.read_text()]


@pytest.mark.parametrize("script", sorted(SCRIPTS))
def test_scripts_print_help(script, capsys):
    with pytest.raises(SystemExit) as end:
        parse(importlib.import_module(f"experiments.{script}").Args, script, ["--help"])
    assert end.value.code == 0 and "--out PATH" in capsys.readouterr().out


def test_template_measures_the_landing_error_over_friction(tmp_path):
    args = template.Args(frictions=(0.1, 0.8), num_jumps=2, out=tmp_path, device="cpu")
    values = template.main(args)
    slippery, nominal = (values[f"friction_{x}_goal_distance_at_end_mean_m"] for x in (0.1, 0.8))
    assert nominal < 0.05 < slippery
    for name in ("metrics.json", "friction.png", "friction_0.1.rrd", "friction_0.8.png"):
        assert (tmp_path / name).stat().st_size > 1000, name


def test_policy_jumps_and_stands_in_plain_mujoco(tmp_path):
    values = mujoco_policy.main(mujoco_policy.Args(height=0.8, seconds=5.0, out=tmp_path))
    assert abs(values["apex_m"] - 0.8) < 0.01 and 0.30 < values["height_at_end_m"] < 0.35


# ---------------------------------------------------------------- the sweep


def height_log(target, apex, end, tilt_deg, rest_speed, early=False):
    """Return the log of finished jumps, one value each: heights [m], end (index in SWEEP_ENDS), rest_speed [m/s]."""
    jumps = JumpLog(np.array(target), SWEEP_ENDS)
    jumps.apex[:, 0], jumps.end[:, 0], jumps.early[:, 0] = apex, end, early
    jumps.tilt[:, 0], jumps.rest_speed[:, 0] = np.radians(tilt_deg), rest_speed
    jumps.yaw[:], jumps.drift[:], jumps.heading[:] = 0.0, 0.0, 0.0
    return jumps


def test_metrics_by_the_open_loop_apex_of_each_robot_match_hand_computed_values():
    jumps = height_log(
        target=[0.50, 0.60, 0.80, 1.00, 1.10, 1.15, 1.18, 1.20],
        apex=[0.59, 0.60, 0.80, 0.80, 1.08, 1.08, 1.09, 1.05],
        end=[0, 0, 4, 0, 2, 0, 0, 0],
        tilt_deg=[5.0, 9.0, 1.0, 2.0, 20.0, 11.0, 3.0, 4.0],
        rest_speed=[0.01, 0.2, np.inf, 0.02, np.inf, 0.01, 0.01, 0.01],
        early=[False] * 6 + [True, False],
    )
    assert values(HeightFlags().metrics(jumps))["success_rate"] == 2 / 8  # 0.50 m and 1.15 m; 1.18 m is early
    assert limits_of(jumps, np.full(8, 1.0748)) == pytest.approx({
        "open_loop_apex_mean_m": 1.0748,
        "open_loop_apex_error_abs_mean_m": (0.0252 + 0.0752 + 0.1052 + 0.1252) / 8,
        "reachable_rate": 6 / 8,
        "reachable_goal_reached_rate": 5 / 6,
        "reachable_success_rate": 2 / 6,
        "unreachable_goal_reached_rate": 1 / 2,
        "reachable_in_range_goal_reached_rate": 4 / 5,
        "reachable_in_range_success_rate": 1 / 5,
        "up_to_limit_apex_error_abs_mean_m": 0.29 / 4,
    })  # fmt: skip
    weak = limits_of(jumps, np.array([1.0, 0.49, 1.0, 1.0, 0.97, 1.0, 1.0, 1.05]))
    assert weak["reachable_rate"] == pytest.approx(3 / 8)  # 0.50, 0.80, 1.00
    assert weak["reachable_goal_reached_rate"] == pytest.approx(2 / 3)
    assert weak["unreachable_goal_reached_rate"] == pytest.approx(4 / 5)  # 0.60, 1.10, 1.15, 1.18


def limits_of(jumps, limit):
    """Return the values of `limit_metrics` for a log and open-loop apexes [m], (num_envs,)."""
    inside = within(jumps.goals[..., 2], (0.5, 1.1))
    return values(limit_metrics(jumps.outcome, jumps.goals[..., 2], limit[:, None], inside))


@pytest.fixture(scope="module")
def sweep_env():
    """Return an environment of three nominal robots with the terminations of the sweep."""
    return env_of_recipe(
        still_policy("vertical-jump").recipe(), 3, Conditions(device="cpu"), change=with_jump_terminations
    )


@pytest.mark.parametrize(("begin", "early"), [(31, False), (-45, True)])
def test_scripted_jump_reaches_open_loop_height_and_is_early_before_command(sweep_env, begin, early):
    targets = np.array([0.5, 0.7, 1.05])
    log = JumpLog(targets, sweep_env.task.termination_names)
    run_evaluation(OpenLoopPolicy(begin).act, sweep_env, log)
    metrics = values(HeightFlags().metrics(log))
    assert metrics["apex_max_m"] == pytest.approx(OPEN_LOOP_APEX, abs=0.02)
    assert metrics["landed_rate"] == 1.0
    assert metrics["early_rate"] == (1.0 if early else 0.0)
    assert metrics["success_rate"] == pytest.approx(0.0 if early else 1 / 3)


def test_sweep_of_a_run_writes_metrics_plot_recording_and_picture(tmp_path):
    cfg = TrainCfg(num_envs=16, max_iterations=2, log_root=tmp_path / "logs", device="cpu", tensorboard=False)
    run = train(Recipe(make_task("vertical-jump"), replace(cfg, ppo=PpoCfg(num_steps=48)))).folder
    reported = HeightSweep(
        policy=str(run), num_jumps=3, num_recorded=2, randomize=True, out=tmp_path, device="cpu"
    ).run()
    saved = read_values(tmp_path)
    assert saved == reported
    assert {*HeightSweep.paper, "success_rate", "open_loop_apex_mean_m"} <= saved.keys()
    assert 0.7 < saved["open_loop_apex_mean_m"] < 1.3 and saved["trained_range_m"] == [0.45, 1.15]
    assert saved["latency"].endswith(" ms") and 0.0 < saved["latency_ms"] < 17.0
    assert (saved["torque_limit_nm"], saved["randomize"]) == (18.0, True)
    for name in ("sweep.png", "jumps.rrd", "jumps.png"):
        assert (tmp_path / name).stat().st_size > 1000, name


# ---------------------------------------------------------------- benchmark


def test_training_benchmark_reports_rates_of_solver_environment_and_both_trainers(tmp_path):
    args = benchmark_training.Args(
        envs=(8,), train_envs=16, steps=4, repeats=1, iterations=1, num_steps=8, out=tmp_path, device="cpu",
        eager=True,
    )  # fmt: skip
    values = benchmark_training.main(args)
    assert values == read_values(tmp_path)
    rates = [values[f"{what}_steps_per_s_{n}"] for what in ("solver", "env") for n in (8, 16)]
    assert min(*rates, values["ppo_steps_per_s"], values["rsl_rl_steps_per_s"], values["ppo_steps_per_s_eager"]) > 0.0


def test_errors_of_a_solver_decrease_with_finer_steps(tmp_path):
    args = solver_accuracy.Args(num_robots=2, jumper=(1, 4), mujoco=(), out=tmp_path, device="cpu")
    values = solver_accuracy.main(args)
    assert 0.0 < values["jumper_4_apex_mm"] < 0.8 * values["jumper_1_apex_mm"] < 2.0


@pytest.mark.parametrize("settings", [{"envs": [2]}, {"envs": [32], "solvers": ["jumper"], "threads": [1, 2]}])
def test_solver_benchmark_jumps_before_it_is_timed(tmp_path, settings):
    values = benchmark_solver.main(benchmark_solver.Args(**settings, repeats=1, steps=2, out=tmp_path, device="cpu"))
    assert values == read_values(tmp_path)
    assert values["jumper_apex_m"] > 0.8 and values.get("mujoco_apex_m", 1.0) > 0.8
    assert values["jumper_steps_per_s_jump"] > 0.0


def test_gradient_cost_reports_gradient_error_and_saved_bytes(tmp_path):
    values = gradient_cost.main(gradient_cost.Args(num_envs=2, repeats=1, out=tmp_path, device="cpu"))
    assert values == read_values(tmp_path)
    assert values["height_difference_m"] == 0.0 and values["kept_bytes_a_policy_step"] <= 2000.0
    assert values["cpu_ratio"] == pytest.approx(values["gradient_us_a_step"] / values["plain_us_a_step"])
    for name in ("targets", "q", "qd", "table", "saturation"):
        assert 0.0 < values[f"error_{name}"] < 0.02


# ---------------------------------------------------------------- experiments at a tiny size


def test_demo_prints_one_summary_of_all_parts_and_writes_a_film(tmp_path, capsys):
    values = demo.main(demo.Args(num_jumps=3, size=(96, 64), out=tmp_path, device="cpu"))
    lines, saved = capsys.readouterr().out.splitlines(), saved_metrics(tmp_path)
    assert len(lines) <= 24 and max(len(line.replace(str(tmp_path), "outputs/demo")) for line in lines) <= 80
    assert set(saved) == set(values) and all(saved[key].value is not None for key in demo.SUMMARY)
    vertical = saved_metrics(tmp_path / "vertical_jump")
    assert saved["vertical_goal_reached_rate"] == vertical["goal_reached_rate"]
    assert saved["open_loop_apex_height_m"].value == pytest.approx(1.075, abs=0.01)
    assert saved["filmed_goal_distance_at_rest_m"].value < 0.1
    for name in ("jump.mp4", "jump.png", "jump.rrd", "open_loop/jump.rrd", "horizontal_jump/sweep.png"):
        assert (tmp_path / name).stat().st_size > 1000, name


def test_springs_raise_the_apex(tmp_path):
    args = leg_springs.Args(stiffness=(0.0, 500.0), squat_angles=(120.0,), filter="stock", out=tmp_path, device="cpu")
    values = leg_springs.main(args)
    assert read_values(tmp_path) == values
    without, with_springs = values["stock_apex_m"]
    assert without == pytest.approx(1.075, abs=0.01) and with_springs == pytest.approx(1.243, abs=0.01)
    assert values["stock_highest_apex_height_m"] == with_springs and (tmp_path / "springs.png").is_file()


def test_rescue_identifies_a_weak_motor_in_two_processes_and_lists_outcomes(tmp_path):
    args = rescue.Args(
        changes=("weak_motor",), modes=("known", "identified"), count=1, nominal=0, timed=0, candidates=8, seed=0,
        processes=2, threads=1, out=tmp_path, device="cpu",
    )  # fmt: skip
    values = rescue.main(args)
    assert values["weak_motor_identified_smallest_torque_factor"] == pytest.approx(0.5, abs=0.05)
    assert abs(values["weak_motor_identified_added_mass_kg"]) < 0.2
    rows = json.loads((tmp_path / "outcomes.json").read_text())
    saved = np.array([[row["outcome"] == "success" for row in rows if row["mode"] == mode] for mode in args.modes])
    assert saved.shape == (2, 1) and saved.any()
    assert values["weak_motor_savable_rate"] == saved.any(0).mean()
    assert values["weak_motor_known_saved_of_savable_rate"] == saved[0].sum() / saved.any(0).sum()
    noisy = rescue.main(rescue.Args(**vars(args) | {"modes": ("identified",), "noise": True}))
    assert noisy["weak_motor_identified_smallest_torque_factor"] == pytest.approx(0.5, abs=0.05)


def test_teacher_writes_the_policy_that_imitates_planned_jumps(tmp_path):
    values = teacher.main(teacher.Args(robots=3, goals=(0.9, 1.3), epochs=1, threads=1, out=tmp_path, device="cpu"))
    assert values["teacher_success_rate"] > values["policy_of_earth_success_rate"] == 0.0
    assert teacher.Policy.load(tmp_path / "policy").interface.task == teacher.NAME


def test_walk_jump_walk_with_two_robots_succeeds(tmp_path, monkeypatch):
    monkeypatch.setattr(walk_jump_walk, "WALKS", (1, 1, 1))
    monkeypatch.setattr(walk_jump_walk, "EACH", 1.5)
    values = walk_jump_walk.main(walk_jump_walk.Args(num_robots=2, num_recorded=1, out=tmp_path, device="cpu"))
    metrics = read_values(tmp_path)
    assert metrics == values
    assert metrics["finished_rate"] == metrics["jump_made_rate"] == 1.0
    assert json.loads((tmp_path / "metrics.json").read_text())["conditions"]["gravity_m_s2"] == 9.81
    assert metrics["apex_error_abs_mean_m"] < 0.05 and metrics["goal_distance_at_handover_mean_m"] < 0.05
    assert 0.0 < metrics["settled_slewed_rmse_vx_m_s"] < 0.2 and 0.2 < metrics["command_to_takeoff_mean_s"] < 2.5
    assert (tmp_path / "timeline.png").is_file() and (tmp_path / "walk_jump_walk.rrd").stat().st_size > 10_000
