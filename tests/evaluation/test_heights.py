import math

import numpy as np
import pytest

from jumper_warp.evaluation.jump_metrics import HeightFlags
from jumper_warp.evaluation.jumps import JumpLog
from metric_helpers import values


def make_arrays(jumps, **changes):
    """Return the arrays of `JumpLog.read_env`, (num_envs, ...), of robots standing at the origin, with some changed."""
    count = len(jumps.goals)
    arrays = {
        "phase": np.zeros(count, dtype=int), "phase_steps": np.zeros(count, dtype=int),
        "termination": np.full(count, -1), "peak_tilt": np.zeros(count),
        "base_vel": np.zeros((count, 3)), "steps": np.full(count, 40),
        "command_step": np.full(count, 30), "base_pos": np.zeros((count, 3)),
        "base_quat": np.tile([0.0, 0.0, 0.0, 1.0], (count, 1)), "start": np.zeros((count, 3)),
        "heading": np.zeros(count), "goal": np.zeros((count, 3)), "touched_down": np.zeros(count, dtype=int),
        "up": np.zeros(count), "paws_down": np.ones((count, 4), dtype=bool), "paw_pos": np.zeros((count, 4, 2)),
        "took_off": np.zeros(count, dtype=int), "transversal": np.zeros(count),
    }  # fmt: skip
    return arrays | {name: np.array(value) for name, value in changes.items()}


def fly(jumps, heights):
    """Record a policy step of flight at base heights [m], one per jump."""
    base_pos = np.zeros((len(heights), 3))
    base_pos[:, 2] = heights
    assert not jumps.update(make_arrays(jumps, phase=[1] * len(heights), base_pos=base_pos), 1.0 / 60.0)


def metrics_of(jumps):
    """Return the values of `jumper evaluate` for a log."""
    return values(HeightFlags(success_range=(0.5, 1.1)).metrics(jumps))


def test_height_metrics_match_hand_computed_values():
    jumps = JumpLog(np.array([0.5, 0.8, 1.1, 1.2]), ("success", "diverged", "collided"))
    landed = {"phase": [2, 0, 2, 1], "phase_steps": [60, 0, 60, 0]}
    for heights in ([0.45, 0.5, 0.9, 0.4], [0.52, 1.0e13, 1.06, 0.9], [0.51, 0.4, 0.8, 0.8]):
        fly(jumps, heights)
    half = [math.radians(0.5 * angle) for angle in (10.0, 90.0, -26.0, 0.0)]  # half yaw angles
    base_poses = {
        "base_pos": [[0.06, -0.08, 0.3], [9.0, 0.0, 0.0], [0.0, 0.3, 0.3], [0.0] * 3],
        "base_quat": [[0.0, 0.0, math.sin(angle), math.cos(angle)] for angle in half],
    }
    speeds = {"base_vel": [[0.0, 0.03, 0.04], [9.0] * 3, [0.0, 0.0, -0.2], [0.0] * 3]}
    first = make_arrays(
        jumps,
        termination=[0, 1, 0, -1],
        touched_down=[1, 0, 1, 0],
        peak_tilt=[0.1, 3.0, 0.2, 0.0],
        **landed,
        **speeds,
        **base_poses,
    )
    assert not jumps.update(first, 1.0 / 60.0)
    later = {"base_pos": np.full((4, 3), 9.0), "peak_tilt": [3.0] * 4, "phase": [2] * 4}
    assert jumps.update(make_arrays(jumps, termination=[2, 2, 2, 2], **later), 1.0 / 60.0)
    metrics = metrics_of(jumps)
    expected = {
        "apex_error_abs_mean_m": (0.02 + 0.04 + 0.3) / 3,
        "apex_error_signed_mean_m": (0.02 - 0.04 - 0.3) / 3,
        "in_range_apex_error_abs_mean_m": 0.03,
        "apex_error_abs_max_of_successes_m": 0.02,
        "apex_max_m": 1.06,
        "success_rate": 0.25,
        "goal_reached_rate": 0.5,
        "landed_rate": 0.5,
        "in_range_success_rate": 1.0 / 3.0,
        "in_range_goal_reached_rate": 2.0 / 3.0,
        "at_rest_rate": 0.25,
        "landing_tilt_mean_deg": math.degrees(0.15),
        "landing_tilt_max_deg": math.degrees(0.2),
        "no_paw_lift_rate": 0.5,
        "second_takeoff_rate": 0.0,
        "drift_mean_m": 0.2,
        "drift_max_m": 0.3,
        "turn_abs_mean_deg": 18.0,
        "turn_abs_max_deg": 26.0,
        "beyond_authors_limits_rate": 0.5,
        "success_within_authors_limits_rate": 0.25,
        "height_at_end_mean_m": 0.3,
        "collision_rate": 0.25,
        "fall_rate": 0.5,
        "miss_rate": 0.0,
        "diverged_rate": 0.25,
    }
    assert {name: metrics[name] for name in expected} == pytest.approx(expected, abs=1e-9)


def test_jump_that_takes_off_before_command_can_be_seen_is_early():
    jumps = JumpLog(np.array([0.5, 0.8, 1.0]), ("success", "diverged"))
    for step, took_off in ((29, [0, 1, 0]), (30, [0, 0, 1]), (31, [1, 0, 0])):
        jumps.update(make_arrays(jumps, steps=[step] * 3, took_off=took_off), 1.0 / 60.0)
    assert jumps.early[:, 0].tolist() == [False, True, True]


def test_landing_from_wrong_height_counts_as_miss_not_fall():
    jumps = JumpLog(np.array([0.5, 0.6, 0.7]), ("low_base", "success"))
    fly(jumps, [0.7, 0.6, 0.65])
    changes = {"termination": [-1, 0, -1], "phase": [2, 2, 2], "phase_steps": [60, 3, 60]}
    jumps.update(make_arrays(jumps, **changes), 1.0 / 60.0)
    metrics = metrics_of(jumps)
    assert [metrics[name] for name in ("success_rate", "fall_rate", "miss_rate")] == pytest.approx([1 / 3] * 3)


def test_heights_of_stance_squat_and_end_and_the_largest_angle_in_flight():
    jumps = JumpLog(np.array([0.5]), ("success",), rest=2.0)
    course = [  # step, phase, height [m], transversal [rad]
        (29, 0, 0.38, 0.9), (30, 0, 0.36, 1.0), (31, 0, 0.30, 1.9), (32, 0, 0.21, 1.8), (33, 0, 0.4, 1.2),
        (34, 1, 0.45, 0.5), (35, 1, 0.50, 1.5), (36, 1, 0.42, 1.1), (37, 2, 0.20, 2.2), (38, 2, 0.34, 0.7),
    ]  # fmt: skip
    for step, phase, height, angle in course:
        changes = {"phase": [phase], "base_pos": [[0.0, 0.0, height]], "transversal": [angle], "phase_steps": [step]}
        jumps.update(make_arrays(jumps, steps=[step], **changes), 1.0 / 60.0)
    outcome = jumps.outcome
    heights = (outcome.stance_m, outcome.squat_m, outcome.height_at_end_m)
    assert [each[0, 0] for each in heights] == [0.36, 0.21, 0.34]
    assert outcome.transversal_deg[0, 0] == pytest.approx(math.degrees(1.5))
