"""Attitude control as a skill in the flight of a jump: handovers to and from the jump, goal, and metrics."""

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from columns import Z
from experiments.flight_attitude import JUMP, OUTCOMES, TURN, FlightLog, flight_metrics
from jumper_warp.envs.env import Env
from jumper_warp.registry import make_task
from jumper_warp.tasks.switching import flight_skills
from metric_helpers import values

N = 4
LATE = np.array([[0.01, 0.0], [-0.01, 0.0], [0.0, 0.01], [0.0, 0.0]])
MARS = 3.71


@pytest.fixture(scope="module")
def flown():
    """Return environment, flight log and states by step of robots that take off with a tilt, with legs held still."""
    tasks, handovers = flight_skills(make_task("vertical-jump-mars"), make_task("attitude"))
    env = Env(tasks, N, device="cpu", randomize=False, noise=False, auto_reset=False, handovers=handovers)
    flights, seen = FlightLog(np.full(len(LATE), 2.5), LATE), []
    flights.begin(env)
    for _ in range(round(flights.seconds / env.step_dt)):
        action = torch.tensor(flights.action(90.0, None), dtype=torch.float32)
        env.step(torch.stack([action, torch.zeros(N, 12)]))
        turn, jump = (env.skills[skill].states.numpy().copy() for skill in (TURN, JUMP))
        height, rise = env.sim.joint_q()[:, Z].copy(), env.sim.joint_qd()[:, Z].copy()
        seen.append((env.episodes.skill.numpy().copy(), turn, jump, height, rise))
        if flights.record_step(env):
            break
    return env, flights, seen


def test_turning_takes_over_in_flight_and_hands_back_before_touchdown(flown):
    _, flights, seen = flown
    skills = np.array([skill for skill, *_ in seen])
    for world in range(N):
        changes = np.flatnonzero(np.diff(skills[:, world])) + 1
        assert [skills[change, world] for change in changes] == [TURN, JUMP]
        up, down = changes
        assert seen[up][4][world] > 2.0 and seen[down][4][world] < -2.0
        # time to fall to 0.45 m: a little less than 0.35 s
        height, rise = seen[down][3][world], seen[down][4][world]
        under_root = rise**2 + 2.0 * MARS * (height - 0.45)
        assert 0.30 < (rise + np.sqrt(under_root)) / MARS <= 0.35
    assert (skills[-1] == JUMP).all() and flights.flight_time.min() > 2.0


def test_the_goal_is_level_in_the_jumps_heading_and_the_jump_continues_after_it(flown):
    _, _, seen = flown
    turning = next(turn for skill, turn, *_ in seen if (skill == TURN).all())
    euler = Rotation.from_quat(turning["goal"]).as_euler("ZYX")
    np.testing.assert_allclose(euler, 0.0, atol=1e-6)
    np.testing.assert_allclose(turning["jump_goal"][:, Z], 2.5)
    landing = next(jump for i, (skill, _, jump, *_) in enumerate(seen) if i > 100 and (skill == JUMP).all())
    np.testing.assert_allclose(landing["goal"], turning["jump_goal"])
    assert (landing["phase"] >= 1).all() and (landing["max_height"] > 2.0).all()


def test_legs_that_push_off_later_tilt_the_robot(flown):
    _, flights, _ = flown
    assert flights.takeoff_spin[:3].min() > 0.2 > flights.takeoff_spin[3]
    assert np.degrees(flights.touchdown_tilt[:3]).min() > 5.0 > np.degrees(flights.touchdown_tilt[3])
    metrics = flight_metrics(flights)
    assert metrics["apex_mean_m"].trials == N and 2.5 < metrics["apex_mean_m"].value < 3.2
    change = metrics["angular_momentum_change_in_flight_max_nm_s"].value
    assert change < 1.0e-4 < 0.1 * flights.takeoff_momentum.max()


def test_failures_in_flight_are_counted_separately():
    flights = FlightLog(np.full(4, 2.5))
    flights.end[:] = [OUTCOMES.index(name) for name in ("collided", "collided", "landed", "tilted")]
    flights.flight_time[1:] = 2.0
    metrics = values(flight_metrics(flights))
    assert metrics["ended_by_collided_rate"] == 0.5 and metrics["failed_before_touchdown_rate"] == 0.25
