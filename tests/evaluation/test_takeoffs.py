import math

import numpy as np
import pytest
import torch

from jumper_warp.robot.motors import horizontal_jump_filter
from jumper_warp.tasks.units import G
from support.takeoff_search import NOMINAL, env_of_limit
from support.takeoffs import (
    LANDING_ACTION,
    Flight,
    Takeoffs,
    both_sides,
    capture_distance,
    fly,
    mean_of_sides,
    reach,
    stopping_time,
)

pytestmark = pytest.mark.usefixtures("one_thread")


@pytest.fixture(scope="module")
def env():
    return env_of_limit(NOMINAL, 8, "cpu")


@pytest.fixture
def standing(env):
    env.evaluation_reset(np.zeros((8, 4)))
    return Takeoffs(env)


def scripted(lean):
    """Actions (8, steps, 4) that squat and stretch; the hind legs stretch `lean` policy steps after the front ones."""
    actions = np.full((8, 48, 4), 0.9)
    actions[:, 30:, :2] = -1.0
    actions[:, 30 + lean :, 2:] = -1.0
    return actions


def test_predicted_flight_is_the_flight(env):
    """In the air nothing but gravity moves the centre of mass: it is where the parabola of the takeoff says."""
    takeoffs = fly(env, scripted(3))
    assert takeoffs.off.all() and (takeoffs.air_time > 0.5).all()
    com, vel = takeoffs.com.copy(), takeoffs.com_vel.copy()
    before = takeoffs._since.copy()
    for _ in range(6):
        env.step(torch.full((8, 12), 0.2))
        takeoffs.look()
    now = takeoffs._whole(np.arange(8), *takeoffs._links())[0]
    time = (takeoffs._since - 1)[:, None] * env.step_dt
    assert (takeoffs._since == before + 6).all()
    expected = com + vel * time - 0.5 * G * time**2 * np.array([0.0, 0.0, 1.0])
    np.testing.assert_allclose(now, expected, atol=5e-3)  # 480 steps of Euler a second


def test_jump_is_told_by_its_takeoff_and_touchdown(env):
    takeoffs = fly(env, scripted(3), to_rest=True)
    flight = Flight.of(takeoffs, 0, friction=0.85)
    forward, _, up = takeoffs.com_vel[0]
    assert flight.takeoff_speed_m_s == pytest.approx(math.hypot(forward, up), rel=1e-3)
    assert flight.landing_down_speed_m_s == pytest.approx(G * takeoffs.air_time[0] - up)
    assert flight.base_at_touchdown_m == pytest.approx(flight.flight_m, abs=0.15)  # posture and height differ
    assert 0.0 < flight.apex_m - takeoffs.com[0, 2] - up**2 / (2.0 * G) < 0.1  # the legs hang below the base


def test_flight_against_hand_numbers(standing):
    takeoffs = standing
    height = takeoffs.start[0, 2] - takeoffs.env.sim.joint_q()[0, 2] + 0.30
    assert takeoffs.start[0, 2] == pytest.approx(0.3677, abs=1e-3)
    takeoffs.off[:7] = True
    takeoffs.com[:] = takeoffs.start + [0.3, 0.0, 0.0]
    takeoffs.com[:, 2] = height  # 2 x 2.4525 / 9.81 = 0.5 s in the air
    takeoffs.com_vel[:] = [2.0, 0.0, 2.4525]
    takeoffs.spin[:], takeoffs.pitch[:] = 1.0, 0.1
    assert takeoffs.air_time == pytest.approx(0.5, abs=1e-5)
    assert takeoffs.flight == pytest.approx([1.3] * 7 + [0.0], abs=1e-5)
    assert takeoffs.landing_pitch == pytest.approx(0.6, abs=1e-5)


def test_spin_is_that_of_a_robot_turned_as_a_whole(standing):
    """With every joint still the angular momentum is inertia times rate, whatever the frame of a link."""
    env = standing.env
    qd = env.sim.joint_qd()
    qd[:, :6] = 0.0
    qd[:, 4] = 1.5
    env.sim.state.joint_qd.assign(qd.ravel())
    _, vel, momentum, inertia = standing._whole(np.arange(8), *standing._links())
    assert momentum == pytest.approx(1.5 * inertia, rel=1e-4)
    assert np.abs(vel).max() < 0.1
    assert 0.6 < inertia[0] < 1.0


def test_a_jump_with_a_run_up_counts_for_nothing(standing):
    """A hind paw on the ground 0.1 m ahead of its start is a step."""
    env = standing.env
    q = env.sim.joint_q()
    q[4:, 0] += 0.1
    env.sim.state.joint_q.assign(q.ravel())
    env.step(torch.zeros(8, 12))
    standing.look()
    assert standing.bad.tolist() == [False] * 4 + [True] * 4


def test_a_policy_acts_only_after_takeoff(env):
    """What acts after takeoff sees the observation, and changes nothing about the takeoff."""
    seen = []

    def act(obs):
        seen.append(obs.shape)
        return torch.tensor([0.0, LANDING_ACTION, LANDING_ACTION]).repeat(len(obs), 4)

    held, acted = fly(env, scripted(3)), fly(env, scripted(3), act)
    np.testing.assert_array_equal(acted.com_vel, held.com_vel)
    assert set(seen) == {tuple(env.obs.shape)}


def test_rows_of_actions_go_to_both_sides():
    rows = np.array([[0.1, 0.2, 0.3, 0.4]])
    expected = [0.0, 0.1, 0.2, 0.0, 0.1, 0.2, 0.0, 0.3, 0.4, 0.0, 0.3, 0.4]
    assert both_sides(rows)[0] == pytest.approx(expected)
    assert mean_of_sides(both_sides(rows))[0] == pytest.approx(rows[0])


def test_landing_estimate_against_hand_numbers():
    """Forward 2 m/s at a height of 0.25 m: a pendulum asks for 2 x sqrt(0.25 / 9.81) = 0.319 m."""
    assert capture_distance(2.0, 0.25, 9.81) == pytest.approx(0.3193, abs=1e-4)
    # friction 0.5 takes 2 m/s with an impulse of 4 m/s: 1 of the fall, 3 of 3 / 9.81 s of weight
    assert stopping_time(2.0, 1.0, 0.5, 9.81) == pytest.approx(0.3058, abs=1e-4)
    assert stopping_time(2.0, 1.0, 3.0, 9.81) == 0.0
    # outer thigh level, inner one 30 degrees beyond its twin: 0.24 m to the middle of the hips and 0.32 m of leg
    assert reach(horizontal_jump_filter(), 0.30) == pytest.approx(0.56, abs=0.01)
