"""A driven robot: velocities, jumps to clicked places, physical values, pushes, grounds, and other tasks."""

from dataclasses import astuple
from queue import SimpleQueue
from types import SimpleNamespace

import numpy as np
import pytest

from drive_helpers import session_of
from jumper_warp.evaluation.conditions import Conditions
from jumper_warp.evaluation.skills import SkillNames
from jumper_warp.live.page import Page


@pytest.fixture(scope="module")
def walker():
    """Return a robot that walks and jumps, for all tests of this module."""
    return session_of(*astuple(SkillNames()))


@pytest.fixture
def session(walker):
    """Return the robot with its physical values as built, at the start of an episode."""
    walker.values = dict(walker.nominal)
    walker.velocity = np.zeros(3)
    walker.reset()
    walker.values = {}
    return walker


def advance(session, seconds, until=lambda session: False):
    """Advance a session until a condition holds, at most some time [s]; return the largest height of the base [m]."""
    heights = []
    for _ in range(round(60 * seconds)):
        session.step()
        heights.append(session.position[2])
        if until(session):
            break
    return max(heights)


def finish_jump(session):
    """Advance a session until its jump is over; return the largest height of the base [m]."""
    return advance(session, 10.0, lambda session: session.jump is None or session.fallen)


def test_robot_follows_the_commanded_velocity(session):
    session.velocity = np.array([0.5, 0.0, 0.0])
    advance(session, 2.0)
    assert 0.6 < session.position[0] < 1.0
    assert session.series()["velocity/ahead [m/s]"] == pytest.approx(0.5, abs=0.15)


@pytest.mark.parametrize("goal", [(1.0, 0.0), (-0.8, 0.3), (0.1, 2.8)], ids=["ahead", "behind", "far to the left"])
def test_robot_lands_within_5_cm_of_its_goal(session, goal):
    session.jump_to(np.array(goal))
    assert finish_jump(session) > 0.42  # it jumps
    assert not session.fallen
    assert np.linalg.norm(session.position[:2] - goal) < 0.05


def test_jump_up_reaches_the_commanded_height(session):
    session.jump_up(0.9)
    assert finish_jump(session) == pytest.approx(0.9, abs=0.1)


def test_cancelled_jump_does_not_happen(session):
    session.jump_up(0.9)
    session.step()
    session.cancel_jump()
    assert advance(session, 2.0) < 0.45


def test_payload_and_gravity_act_at_once(session):
    advance(session, 0.5)
    before = session.env.robot.paw_force.numpy()[..., 2].sum()
    session.set_value("payload [kg]", 3.0)
    session.set_value("gravity [m/s²]", 5.0)
    advance(session, 1.0)
    after = session.env.robot.paw_force.numpy()[..., 2].sum()
    assert after == pytest.approx((before / 9.81 + 3.0) * 5.0, rel=0.02)


def test_values_of_the_driver_outlast_a_reset(session):
    session.set_value("latency [ms]", 10.0)
    session.set_value("friction [1]", 0.2)
    session.reset()
    parameters = session.env.parameters
    assert parameters.latency.numpy()[0] == 5  # physics steps of 1/480 s
    assert parameters.shape_mu.numpy()[parameters.paw_shapes.numpy()] == pytest.approx(0.2)


def test_other_values_of_the_conditions_stay_when_the_driver_changes_one():
    session = session_of("vertical_jump", conditions=Conditions(device="cpu", threads=1, friction=0.3, latency=10.0))
    assert session.nominal["friction [1]"] == pytest.approx(0.3)
    session.set_value("payload [kg]", 1.0)
    parameters = session.env.parameters
    assert parameters.latency.numpy()[0] == 5  # physics steps of 1/480 s
    assert parameters.shape_mu.numpy()[parameters.paw_shapes.numpy()] == pytest.approx(0.3)


def test_command_that_is_refused_is_shown_and_the_page_continues():
    session = session_of("attitude", agent="hold")
    page, shown = SimpleNamespace(session=session, requests=SimpleQueue(), stopped=False, visitors={}, speed=1.0), []
    page.notify = lambda title, text: shown.append(text)
    page.requests.put(lambda: session.env.command([0.0] * 4))
    page.requests.put(lambda: setattr(page, "stopped", True))
    Page.run(page)
    assert len(shown) == 1


def test_friction_changes_a_landing(session):
    errors = []
    for friction in (0.9, 0.1):
        session.reset()
        session.set_value("friction [1]", friction)
        session.jump_to(np.array([1.2, 0.0]))
        finish_jump(session)
        errors.append(np.linalg.norm(session.position[:2] - [1.2, 0.0]))
    assert errors[0] < 0.05 < errors[1]


def test_push_moves_the_robot_in_its_direction(session):
    session.push(60.0, 90.0)
    session.step()
    assert session.env.parameters.push.numpy()[0, 1] == pytest.approx(60.0, abs=1.0)
    advance(session, 0.3)
    assert session.position[1] > 0.01
    assert not session.env.parameters.push.numpy().any()


def test_clicked_point_is_on_the_ground(session):
    eye = np.array([-1.0, 0.0, 2.0])
    np.testing.assert_allclose(session.ground_point(eye, np.array([1.0, 0.0, -1.0])), [1.0, 0.0, 0.0], atol=2e-3)
    assert session.ground_point(eye, np.array([1.0, 0.0, 0.1])) is None


def test_robot_begins_anew_on_another_ground(walker):
    walker.build("stairs")
    try:
        advance(walker, 0.3)
        point = walker.ground_point(np.array([0.0, 0.0, 3.0]), np.array([1.0, 0.0, -1.0]))
        assert point[2] == pytest.approx(walker.surface(point[:1], point[1:2])[0], abs=0.02)
        assert abs(point[2]) > 0.02  # beyond the level middle
        assert not walker.fallen
        walker.position = np.array([*point[:2], point[2] + 0.3])
        assert walker.series()["height/base [m]"] == pytest.approx(0.3, abs=0.02)
    finally:
        walker.build("flat")


def test_fallen_robot_is_reset(session):
    session.push(1500.0, 90.0)
    advance(session, 2.0, lambda session: session.fallen)
    assert session.fallen
    advance(session, 1.6)
    assert not session.fallen
    assert abs(session.position[1]) < 0.1


def test_policy_that_only_jumps_is_commanded():
    session = session_of(SkillNames().jump_to)
    assert list(session.kinds()) == ["jump there"]
    session.jump_to(np.array([0.8, 0.0]))
    advance(session, 3.0)
    assert np.linalg.norm(session.position[:2] - [0.8, 0.0]) < 0.05
    session.jump_to(np.array([1.6, 0.0]))
    advance(session, 3.0)
    assert np.linalg.norm(session.position[:2] - [1.6, 0.0]) < 0.08
