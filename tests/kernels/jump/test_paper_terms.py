"""Reward and termination terms of the paper's jumps, by hand numbers."""

import math

import numpy as np
import pytest
import warp as wp

from jump_helpers import DEFAULT_ANGLE, DEG, Table, functions, make_episode, make_view
from jumper_warp.kernels.jump import paper
from jumper_warp.kernels.jump.state import FLIGHT, LANDED, STANCE

NAMES = """jump_height estimated_jump_height tracking estimated_tracking orientation_error flight_orientation_error
landed_posture soft_impact"""
reward = Table(functions(paper, NAMES), float)
ends = Table(functions(paper, "hard_impact predicted_height_miss"), bool)
E = math.exp
PHASES = [int(STANCE), int(FLIGHT), int(LANDED)]
RISING = {"pos": (0.0, 0.0, 0.6), "lin_vel": (0.3, 0.0, 1.962)}  # [m], [m/s] apex 0.6 + 1.962^2 / 19.62 = 0.7962 m


def rolled(angle):
    """Return a quaternion turned by `angle` [rad] about x."""
    return tuple(wp.quat_from_axis_angle(wp.vec3(1.0, 0.0, 0.0), angle))


@pytest.mark.parametrize(("error", "expected"), [(0.0, 4.0), (0.05, E(-0.25) + 3.0 * E(-1.0)), (-0.4, 3.0 * E(-8.0))])
def test_jump_height_is_phi_plus_three_psi_at_the_apex(error, expected):
    episode = make_episode(phase=FLIGHT, at_apex=1, max_height=0.9 + error, goal=(0.0, 0.0, 0.9))
    assert reward("jump_height", make_view(), episode, std=0.1, scale=0.05) == pytest.approx(expected, rel=1e-3)
    episode.at_apex = 0
    assert reward("jump_height", make_view(), episode, std=0.1, scale=0.05) == 0.0


def test_estimated_jump_height_is_ballistic_in_flight_before_the_apex():
    fields = {"goal": (0.0, 0.0, 0.7462)}  # 0.05 m below the estimate
    episodes = [make_episode(phase=phase, **fields) for phase in PHASES]
    values = reward.all("estimated_jump_height", [make_view(**RISING)] * 3, episodes, std=0.1, scale=0.05)
    assert values == pytest.approx([0.0, E(-0.25) + 3.0 * E(-1.0), 0.0], rel=1e-4)
    passed = make_episode(phase=FLIGHT, apex_passed=1, **fields)
    assert reward("estimated_jump_height", make_view(**RISING), passed, std=0.1, scale=0.05) == 0.0


def test_tracking_is_paid_in_every_phase():
    view = make_view(pos=(0.5, 0.0, 0.4))
    episodes = [make_episode(phase=phase, goal=(0.56, 0.08, 0.0)) for phase in PHASES]  # 0.1 m away
    assert reward.all("tracking", [view] * 3, episodes, std=0.1) == pytest.approx([E(-1.0)] * 3, rel=1e-4)


def test_estimated_tracking_is_the_sum_of_two_kernels_of_the_landing_error_in_flight():
    # from 0.3 m upward with 2.4525 m/s: back at 0.3 m after 0.5 s, 0.5 m ahead of 0.1 m
    view = make_view(pos=(0.1, 0.0, 0.3), lin_vel=(1.0, 0.0, 2.4525))
    episodes = [make_episode(phase=phase, goal=(0.9, 0.0, 0.0)) for phase in PHASES]
    values = reward.all("estimated_tracking", [view] * 3, episodes, std=0.3, std_wide=0.6, height=0.3)
    assert values == pytest.approx([0.0, E(-1.0) + 0.1 * E(-0.25), 0.0], rel=1e-4)


def test_orientation_errors_are_kernels_of_the_squared_angle():
    view = make_view(quat=rolled(0.2), lin_vel=(1.0, 0.0, 0.0))
    goals = {"goal": (1.0, 0.0, 0.0)}
    for phase in PHASES:
        episode = make_episode(phase=phase, **goals)
        assert reward("orientation_error", view, episode, std=0.04) == pytest.approx(E(-1.0), rel=1e-4)
        in_flight = E(-1.0) if phase == FLIGHT else 0.0
        assert reward("flight_orientation_error", view, episode, std=0.04) == pytest.approx(in_flight, rel=1e-4)
    past = make_episode(phase=FLIGHT, goal=(-1.0, 0.0, 0.0))
    assert reward("flight_orientation_error", view, past, std=0.04) == 0.0
    turned = make_episode(phase=FLIGHT, heading=0.2, **goals)
    assert reward("orientation_error", make_view(), turned, std=0.04) == pytest.approx(E(-1.0), rel=1e-4)


def test_landed_posture_is_paid_after_touchdown_only():
    angle = DEFAULT_ANGLE + 20.0 * DEG * (np.arange(12) % 3 != 0)
    angle[0] += math.sqrt(12.0) * 10.0 * DEG  # rms offset 10 degrees
    episodes = [make_episode(phase=phase) for phase in PHASES]
    values = reward.all("landed_posture", [make_view(angle=angle)] * 3, episodes, std=10.0 * DEG, shift=20.0 * DEG)
    assert values == pytest.approx([0.0, 0.0, E(-1.0)], rel=1e-4)


IMPACTS = [
    ((0.0, 0.0, -2.0), (0.0, 0.0, 10.0), 0.8),  # falling, slowed down by 10 m/s^2
    ((0.0, 0.0, -2.0), (0.0, 0.0, -9.81), 1.0),  # speeding up
    ((3.0, 0.0, -4.0), (-5.0, 0.0, 10.0), 0.78),  # (-5 * 3 - 10 * 4) / 5 = -11
    ((0.0, 0.0, 1.0), (0.0, 0.0, 240.0), 1.0),  # already moving up
    ((0.0, 0.0, -2.0), (0.0, 0.0, 80.0), 0.0),  # beyond the limit
]  # (velocity after the step [m/s], mean acceleration [m/s^2], soft impact)


@pytest.mark.parametrize(("vel", "acc", "soft"), IMPACTS)
def test_impacts_are_the_deceleration_along_the_present_velocity(vel, acc, soft):
    view = make_view(lin_vel=vel, lin_acc=acc)
    assert reward("soft_impact", view, make_episode(phase=LANDED, phase_steps=17), limit=50.0) == pytest.approx(soft)
    assert reward("soft_impact", view, make_episode(phase=LANDED, phase_steps=18), limit=50.0) == 0.0
    hard = {"stance": 10.5, "flight": 70.0}
    assert ends("hard_impact", view, make_episode(phase=STANCE), **hard) == (soft < 0.79)
    assert ends("hard_impact", view, make_episode(phase=LANDED), **hard) == (soft == 0.0)


@pytest.mark.parametrize(("goal", "miss"), [(0.85, False), (0.95, True), (0.65, True)])
def test_a_predicted_apex_beyond_the_tolerance_ends_at_its_step(goal, miss):
    numbers = {"tolerance": 0.1, "steps": 6.0}
    fields = {"phase": FLIGHT, "goal": (0.0, 0.0, goal)}
    assert ends("predicted_height_miss", make_view(**RISING), make_episode(phase_steps=6, **fields), **numbers) == miss
    for other in ({"phase_steps": 5}, {"phase_steps": 6, "apex_passed": 1}, {"phase_steps": 6, "phase": LANDED}):
        episode = make_episode(**fields | other)
        assert not ends("predicted_height_miss", make_view(**RISING), episode, **numbers)
