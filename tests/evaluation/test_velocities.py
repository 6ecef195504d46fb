"""Metrics of walks of synthetic robots, in closed form."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from experiments.walking_terrain import walked_fraction
from jumper_warp.evaluation import velocities
from jumper_warp.evaluation.velocities import VelocityFlags, VelocityLog
from jumper_warp.registry import make_task
from jumper_warp.utils.metrics import measure
from metric_helpers import values

DT = 1.0 / 60.0  # [s] Policy step
TASK = make_task("velocity-flat")
NAMES = [term.name for term in TASK.terminations]
ROBOTS = 3


def walk_log(velocity_of, *, seconds=2.0, falls=None, task=TASK, commands=None, times=(0.0,), **given) -> VelocityLog:
    """Return a log of ROBOTS robots with random constant orientations, which walk with a given velocity.

    velocity_of: function of time [s], returns (robots, 3) in body axes; falls: policy step of the fall by robot.
    """
    commands = np.tile([0.5, -0.2, 0.4], (ROBOTS, 1, 1)) if commands is None else commands
    walks = VelocityLog(commands, task, seconds, times=np.array(times), **given)
    turn = Rotation.random(ROBOTS, random_state=4)
    for step in range(1, round(seconds / DT) + 1):
        wanted = velocity_of(step * DT)
        vel, ang = np.zeros((ROBOTS, 3)), np.zeros((ROBOTS, 3))
        vel[:, :2], vel[:, 2], ang[:, 2], ang[:, 0] = wanted[:, :2], 0.7, wanted[:, 2], 0.3
        termination = np.full(ROBOTS, -1)
        for robot, fall in (falls or {}).items():
            termination[robot] = NAMES.index("collided") if step >= fall else -1
        arrays = {"base_quat": turn.as_quat(), "base_vel": turn.apply(vel), "base_ang_vel": turn.apply(ang),
                  "base_pos": np.zeros((ROBOTS, 3)), "termination": termination}  # fmt: skip
        walks.update(arrays, DT)
    return walks


def metrics_of(walks):
    """Return the values of the metrics of walks."""
    return values(measure(velocities.VELOCITY_METRICS, walks))


def test_settled_tracking_errors_are_rms_in_body_axes_without_first_second():
    off = np.array([[0.1, 0.0, 0.0], [0.0, -0.2, 0.0], [0.2, 0.0, 0.3]])
    walks = walk_log(lambda t: np.array([0.5, -0.2, 0.4]) + off + (0.0 if t > 1.0 + 1e-6 else 5.0))
    metrics = metrics_of(walks)
    settled = [metrics[f"settled_rmse_{name}"] for name in ("vx_m_s", "vy_m_s", "yaw_rate_rad_s")]
    assert settled == pytest.approx(np.sqrt(np.array([0.05, 0.04, 0.09]) / 3.0), rel=1e-5)
    # over all time, half of the samples are off by 5 more
    squares = np.mean([[0.01, 0.0, 0.04], [5.1**2, 5.0**2, 5.2**2]])
    assert metrics["rmse_vx_m_s"] == pytest.approx(np.sqrt(squares), rel=1e-5)
    assert metrics["fall_rate"] == 0.0 and metrics["slewed_rmse_vx_m_s"] is None


def test_samples_after_a_fall_are_ignored():
    walks = walk_log(lambda t: np.full((ROBOTS, 3), t > 1.5) + np.array([0.5, -0.2, 0.4]), falls={1: 90, 0: 30})
    metrics = metrics_of(walks)
    assert metrics["fall_rate"] == pytest.approx(2.0 / 3.0)
    np.testing.assert_array_equal(walks.outcomes, ["collided", "collided", "walked"])
    np.testing.assert_array_equal(walks.fall_step, [29, 89, 120])
    # robot 1 counts without error from step 61 to 89, robot 2 from 61 to 120, wrong from 91 on
    assert metrics["settled_rmse_vx_m_s"] == pytest.approx(np.sqrt(30.0 / (29.0 + 60.0)), rel=1e-5)


def test_time_out_is_not_a_fall():
    walks = VelocityLog(np.zeros((1, 1, 3)), TASK, 1.0)
    arrays = {name: np.zeros((1, 3)) for name in ("base_pos", "base_vel", "base_ang_vel")}
    arrays |= {"base_quat": np.array([[0.0, 0.0, 0.0, 1.0]]), "termination": np.array([NAMES.index("finished")])}
    walks.update(arrays, DT)
    assert not walks.fallen.any() and walks.outcomes[0] == "walked"


def test_command_history_starts_one_step_after_command():
    commands = np.zeros((ROBOTS, 2, 3))
    commands[:, 1, 0] = 1.0
    walks = walk_log(lambda t: np.zeros((ROBOTS, 3)), commands=commands, times=(0.0, 1.0))
    np.testing.assert_array_equal(walks.command_history()[:, 0, 0], [0.0] * 60 + [1.0] * 60)


def test_slewed_commands_rise_at_their_rate_from_zero():
    commands = np.zeros((ROBOTS, 2, 3))
    commands[:, 0, 0], commands[:, 1, 0] = 0.5, -0.5
    slew = np.array([1.25, 1.25, np.inf])
    walks = walk_log(lambda t: np.zeros((ROBOTS, 3)), commands=commands, times=(0.0, 1.0), slew=slew)
    history, time = walks.command_history()[..., 0], np.arange(1, 121) * DT
    expected = np.where(time <= 1.0 + 1e-9, np.minimum(1.25 * time, 0.5), np.maximum(0.5 - 1.25 * (time - 1.0), -0.5))
    assert history[:, 0] == pytest.approx(expected)
    assert history[:, 2].tolist() == [0.5] * 60 + [-0.5] * 60
    assert metrics_of(walks)["slewed_rmse_vx_m_s"] == pytest.approx(np.sqrt(np.mean(expected**2)))


def test_drift_is_of_robots_commanded_to_stand_until_the_end():
    commands = np.zeros((ROBOTS, 1, 3))
    commands[0, 0, 0] = 0.5
    walks = walk_log(lambda t: np.zeros((ROBOTS, 3)), commands=commands, falls={2: 30})
    walks.distance[:], walks.yaw[:] = [9.0, 0.02, 9.0], [3.0, -0.1, 3.0]
    metrics = measure(velocities.VELOCITY_METRICS, walks)
    drift, turn = metrics["standing_drift_mean_m"], metrics["standing_turn_abs_mean_deg"]
    assert (drift.value, drift.trials, turn.value) == (0.02, 1, pytest.approx(np.degrees(0.1)))


def test_evaluated_walks_change_their_command_at_once_slewed_or_not_at_all():
    log = VelocityFlags(2, (0.8, 0.6, 0.4), 7.0, 3.0).log(TASK, 0)
    assert log.commands.shape == (8 + 8 + 64, 3, 3) and log.times.tolist() == [0.0, 3.0, 6.0]
    np.testing.assert_array_equal(log.commands[:8], log.commands[8:16])
    assert sorted(map(tuple, log.commands[:8, 1])) == sorted(map(tuple, log.commands[:8, 0]))
    masks = log.trials
    assert [int(masks[name].sum()) for name in list(masks)[1:]] == [8, 8, 64]


def test_walked_fraction_stops_at_fall_and_is_at_most_1():
    commands = np.tile([0.5, 0.0, 0.0], (ROBOTS, 1, 1))
    walks = walk_log(lambda t: np.tile([0.3, 0.1, 0.0], (ROBOTS, 1)), seconds=3.0, commands=commands, falls={2: 91})
    assert walked_fraction(walks) == pytest.approx([0.9, 0.9, 0.45], rel=1e-5)  # over the last 2 s
    fast = walk_log(lambda t: np.tile([0.9, 0.0, 0.0], (ROBOTS, 1)), commands=commands)
    assert walked_fraction(fast) == pytest.approx([1.0] * 3)
