import math

import numpy as np
import pytest

from jumper_warp.evaluation.jump_metrics import HeightFlags, HeightPlayFlags, LandingFlags
from jumper_warp.evaluation.jumps import JumpLog, random_headings
from jumper_warp.evaluation.run import write_trials
from jumper_warp.registry import TASKS, make_task
from jumper_warp.tasks.jump.evaluation import TERMINATIONS, with_jump_terminations
from metric_helpers import values

TASK = with_jump_terminations(make_task("horizontal-jump"))


def test_jump_evaluations_check_success_after_failures():
    for name in (name for name in TASKS if "-jump" in name):
        task = make_task(name)
        ends = [term.name for term in task.evaluation.prepare_task(task).terminations]
        assert ends == list(TERMINATIONS), name


def test_flags_have_the_values_of_the_tasks_evaluation():
    evaluation = make_task("vertical-jump-mars").evaluation
    assert evaluation.default_flags("evaluate") == HeightFlags(height_range=(1.0, 3.3), success_range=(1.0, 2.9))
    assert evaluation.default_flags("play") == HeightPlayFlags((1.5, 2.3, 3.0), 6.0)


def test_goals_to_the_side_and_headings_are_independent():
    log = LandingFlags(num_jumps=2000, goal_y=(-0.2, 0.1)).log(TASK, seed=3)
    assert abs(np.corrcoef(log.goals[:, 0, 1], log.headings)[0, 1]) < 0.1
    np.testing.assert_array_equal(log.headings, random_headings(2000, 3))


def test_goals_are_evenly_spaced_ahead_and_sampled_to_the_side():
    flags = LandingFlags(num_jumps=5, goal_y=(-0.2, 0.1))
    log = flags.log(TASK, seed=3)
    assert log.goals[:, 0, 0] == pytest.approx([0.3, 0.6, 0.9, 1.2, 1.5])
    lateral = log.goals[:, 0, 1]
    assert -0.2 <= lateral.min() < lateral.max() <= 0.1
    assert len(set(log.headings)) == 5 and np.abs(log.headings).max() <= math.pi
    assert np.array_equal(flags.log(TASK, seed=3).goals, log.goals)
    assert not np.array_equal(flags.log(TASK, seed=4).headings, log.headings)


def test_heading_flag_in_degrees_sets_all_headings():
    flags = LandingFlags(num_jumps=2, goal_x=(0.3, 0.4), heading=90.0)
    assert flags.log(TASK, 0).headings == pytest.approx(0.5 * math.pi)


def test_success_range_selects_goals_by_distance():
    goals = [[0.3, 0.0], [0.0, -0.3], [0.6, 0.6]]  # [m] at distances 0.3, 0.3 and 0.85
    flags = LandingFlags(num_jumps=3, goal_x=(0.0, 0.0), goal_y=(0.0, 0.0), heading=0.0, success_range=(0.3, 0.5))
    landings = flags.log(TASK, seed=0)  # arrays: (3 worlds, 1 jump in a row)
    landings.goals[:, 0, :2] = goals
    landings.end_position[:, 0], landings.goal_world[:, 0], landings.rest_position[:, 0] = goals, goals, goals
    landings.rest_speed[:] = 0.0
    landings.heading[:], landings.yaw[:], landings.tilt[:] = 0.0, 0.0, 0.0
    landings.end[:, 0] = [*[TERMINATIONS.index("success")] * 2, TERMINATIONS.index("low_base")]
    metrics = flags.metrics(landings)
    assert metrics["success_rate"].value == pytest.approx(2 / 3)
    near = metrics["in_range_success_rate"]
    assert (near.value, near.trials, near.over) == (1.0, 2, "jumps with goals of 0.3 to 0.5 m")


def test_every_rate_follows_from_saved_trials(tmp_path):
    jumps = JumpLog(np.array([0.5, 0.8, 1.0]), ("success", "diverged", "low_base"))
    jumps.end[:, 0], jumps.apex[:, 0], jumps.heading[:] = [0, 1, 2], [0.52, np.nan, 1.05], 0.0
    jumps.rest_speed[0], jumps.touchdown[[0, 2]] = 0.0, 0.0
    write_trials(tmp_path, jumps, 1)
    trials = np.load(tmp_path / "trials.npz", allow_pickle=False)
    metrics = values(HeightFlags().metrics(jumps))
    fields = {"success_rate": "success", "goal_reached_rate": "reached", "landed_rate": "landed", "fall_rate": "fell",
              "at_rest_rate": "at_rest", "no_paw_lift_rate": "still", "diverged_rate": "diverged",
              "miss_rate": "missed", "early_rate": "early", "no_jump_rate": "no_jump",
              "collision_rate": "collided"}  # fmt: skip
    for key, field in fields.items():
        assert trials[field][trials["commanded"]].mean() == metrics[key], key
    assert trials["outcome"].tolist() == ["success", "diverged", "low_base"]
    assert trials["apex_m"] == pytest.approx([0.52, np.nan, 1.05], nan_ok=True)
