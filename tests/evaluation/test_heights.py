import math

import numpy as np
import pytest

from jumper_warp.evaluation.heights import HeightLog, apex_metrics


def make_arrays(jumps, **changes):
    """Return the arrays of `JumpLog.read_env`, (num_envs, ...), of robots standing at the origin, with some changed."""
    count = len(jumps.goals)
    arrays = {
        "phase": np.zeros(count, dtype=int), "phase_steps": np.zeros(count, dtype=int),
        "termination": np.full(count, -1), "max_height": np.zeros(count), "peak_tilt": np.zeros(count),
        "base_vel": np.zeros((count, 3)), "steps": np.full(count, 40),
        "command_step": np.full(count, 30), "base_pos": np.zeros((count, 3)),
        "base_quat": np.tile([0.0, 0.0, 0.0, 1.0], (count, 1)), "start": np.zeros((count, 3)),
        "heading": np.zeros(count), "goal": np.zeros((count, 3)), "touched_down": np.zeros(count, dtype=int),
        "up": np.zeros(count), "paws_down": np.ones((count, 4), dtype=bool),
    }  # fmt: skip
    return arrays | {name: np.array(value) for name, value in changes.items()}


def test_apex_metrics_match_hand_computed_values():
    jumps = HeightLog(np.array([0.5, 0.8, 1.1, 1.2]), ("success", "came_apart", "collided"))
    landed = {"phase": [2, 0, 2, 0], "phase_steps": [60, 0, 60, 0]}
    heights = {"max_height": [0.52, 1.0e13, 1.06, 0.4], "peak_tilt": [0.1, 3.0, 0.2, 0.0]}
    half = [math.radians(0.5 * angle) for angle in (10.0, 90.0, -26.0, 0.0)]  # half yaw angles
    base_poses = {
        "base_pos": [[0.06, -0.08, 0.3], [9.0, 0.0, 0.0], [0.0, 0.3, 0.3], [0.0] * 3],
        "base_quat": [[0.0, 0.0, math.sin(angle), math.cos(angle)] for angle in half],
    }
    speeds = {"base_vel": [[0.0, 0.03, 0.04], [9.0] * 3, [0.0, 0.0, -0.2], [0.0] * 3]}
    first = make_arrays(jumps, termination=[0, 1, 0, -1], **landed, **heights, **speeds, **base_poses)
    assert not jumps.update(first, 1.0 / 60.0)
    later = {"max_height": [9.0, 9.0, 9.0, 0.9], "peak_tilt": [3.0] * 4}
    assert jumps.update(make_arrays(jumps, termination=[2, 2, 2, 2], **later), 1.0 / 60.0)
    metrics = apex_metrics(jumps, (0.5, 1.1))
    expected = {
        "jumps": 4,
        "mean_abs_error_m": (0.02 + 0.04 + 0.3) / 3,
        "mean_abs_error_in_range_m": 0.03,
        "max_abs_error_of_successes_m": 0.04,
        "success_rate": 0.5,
        "success_rate_in_range": 2.0 / 3.0,
        "at_rest_within_1_s_rate": 0.5,
        "mean_landing_tilt_deg": math.degrees(0.15),
        "max_landing_tilt_deg": math.degrees(0.2),
        "still_landing_rate": 0.5,
        "second_takeoff_rate": 0.0,
        "mean_drift_m": 0.2,
        "max_drift_m": 0.3,
        "mean_turn_deg": 18.0,
        "max_turn_deg": 26.0,
        "beyond_authors_drift_or_turn_rate": 0.5,
        "collision_rate": 0.25,
        "fall_rate": 0.5,
        "miss_rate": 0.0,
        "came_apart": 1,
        "failed_by_came_apart": 1,
        "failed_by_collided": 1,
    }
    assert {name: metrics[name] for name in expected} == pytest.approx(expected, abs=1e-9)


def test_unfinished_jump_fails_with_no_end_and_without_landing_metrics():
    jumps = HeightLog(np.array([0.5]), ("success",))
    assert not jumps.update(make_arrays(jumps), 1.0 / 60.0)
    metrics = apex_metrics(jumps, (0.5, 1.1))
    assert metrics["success_rate"] == 0.0 and metrics["failed_by_no_end"] == 1
    assert metrics["max_landing_tilt_deg"] is None


def test_columns_have_one_row_per_jump_and_none_for_nan():
    jumps = HeightLog(np.array([0.5, 0.8]), ("success", "came_apart"))
    landed = {"phase": [2, 0], "phase_steps": [60, 0]}
    jumps.update(make_arrays(jumps, termination=[0, 1], max_height=[0.52, np.nan], **landed), 1.0 / 60.0)
    assert jumps.columns() == {
        "target_m": [0.5, 0.8], "apex_m": [pytest.approx(0.52), None], "error_m": [pytest.approx(0.02), None],
        "end": ["success", "came_apart"],
    }  # fmt: skip


def test_jump_that_has_left_stance_at_command_is_early():
    jumps = HeightLog(np.array([0.5, 0.8, 1.0]), ("success", "came_apart"))
    for step, phase in ((29, [0, 1, 0]), (30, [0, 1, 0]), (31, [1, 2, 0])):
        jumps.update(make_arrays(jumps, steps=[step] * 3, phase=phase), 1.0 / 60.0)
    assert jumps.early[:, 0].tolist() == [False, True, False]


def test_landing_from_wrong_height_counts_as_miss_not_fall():
    jumps = HeightLog(np.array([0.5, 0.6, 0.7]), ("wrong_height", "collided", "success"))
    jumps.update(make_arrays(jumps, termination=[0, 1, -1], phase=[2, 2, 2], phase_steps=[0, 3, 60]), 1.0 / 60.0)
    metrics = apex_metrics(jumps, (0.5, 1.1))
    assert [metrics[name] for name in ("success_rate", "fall_rate", "miss_rate")] == pytest.approx([1 / 3] * 3)
