import math

import numpy as np
import pytest
from jump_helpers import DEG, Table, make_episode, make_view, tilted_by

from kernels.jump import terminations
from kernels.jump.task import FLIGHT, LANDED, STANCE

NAMES = """success too_long came_apart wrong_height low_touchdown low_base moved_away slanted_takeoff tilted hard_impact
no_jump collided early_takeoff"""
holds = Table(terminations, NAMES, bool)


def test_success_comes_a_time_after_touchdown():
    for steps, over in ((59, False), (60, True)):
        landed = make_episode(phase=LANDED, phase_steps=steps)
        assert holds("success", make_view(), landed, 60.0) is over
    for phase in (STANCE, FLIGHT):
        elsewhere = make_episode(phase=phase, phase_steps=200)
        assert not holds("success", make_view(), elsewhere, 60.0)


def test_too_long():
    for steps, over in ((1199, False), (1200, True)):
        assert holds("too_long", make_view(), make_episode(steps=steps), 1200.0) is over


@pytest.mark.parametrize(
    ("robot", "broken"),
    [
        ({}, False),
        ({"lin_vel": (0.0, 0.0, 14.9)}, False),
        ({"lin_vel": (0.0, 0.0, 15.1)}, True),
        ({"ang_vel": (0.0, 39.9, 0.0)}, False),
        ({"ang_vel": (0.0, -40.1, 0.0)}, True),
        ({"rate": np.eye(12)[7] * -119.9}, False),
        ({"rate": np.eye(12)[7] * -120.1}, True),
        ({"pos": (math.nan, 0.0, 0.4)}, True),
        ({"lin_vel": (0.0, math.inf, 0.0)}, True),
        ({"ang_vel": (0.0, math.nan, 0.0)}, True),
        ({"rate": np.where(np.arange(12) == 7, math.nan, 0.0)}, True),
        ({"angle": np.where(np.arange(12) == 7, math.nan, 0.0)}, True),
    ],
)
def test_came_apart_at_speeds_and_values_no_robot_has(robot, broken):
    assert holds("came_apart", make_view(**robot), make_episode()) is broken


@pytest.mark.parametrize(
    ("error", "missed"), [(0.0, False), (0.09, False), (-0.09, False), (0.11, True), (-0.11, True)]
)
def test_wrong_height_counts_at_touchdown(error, missed):
    fields = {"goal": (0.0, 0.0, 0.8), "max_height": 0.8 + error, "phase": LANDED}
    assert holds("wrong_height", make_view(), make_episode(touched_down=1, **fields), 0.1) is missed
    assert not holds("wrong_height", make_view(), make_episode(touched_down=0, **fields), 0.1)


def test_low_touchdown_and_low_base():
    for z, low in ((0.21, False), (0.19, True)):
        view = make_view(pos=(0.0, 0.0, z))
        assert holds("low_touchdown", view, make_episode(touched_down=1), 0.2) is low
        assert not holds("low_touchdown", view, make_episode(touched_down=0), 0.2)
        assert holds("low_base", view, make_episode(), 0.2) is low


def test_moved_away_is_measured_in_the_plane_from_the_start():
    start = make_episode(start=(1.0, -1.0, 0.3))
    assert not holds("moved_away", make_view(pos=(1.11, -0.85, 1.2)), start, 0.2)
    assert holds("moved_away", make_view(pos=(1.13, -0.84, 0.3)), start, 0.2)


def test_slanted_takeoff():
    for vx, slanted in ((0.59, False), (0.61, True)):
        view = make_view(lin_vel=(vx, -0.45, 3.0))  # 0.6, 0.45: 0.75 m/s
        assert holds("slanted_takeoff", view, make_episode(phase=FLIGHT, took_off=1), 0.75) is slanted
        assert not holds("slanted_takeoff", view, make_episode(phase=FLIGHT), 0.75)


@pytest.mark.parametrize("axis", [(1.0, 0.0, 0.0), (0.0, -1.0, 0.0), (0.6, 0.8, 0.0)])
def test_tilted_about_any_horizontal_axis(axis):
    assert not holds("tilted", make_view(**tilted_by(24.9 * DEG, axis)), make_episode(), 25.0 * DEG)
    assert holds("tilted", make_view(**tilted_by(25.1 * DEG, axis)), make_episode(), 25.0 * DEG)
    assert holds("tilted", make_view(**tilted_by(180.0 * DEG, axis)), make_episode(), 25.0 * DEG)


def test_turning_about_the_vertical_is_no_tilt():
    assert not holds("tilted", make_view(**tilted_by(2.0, (0.0, 0.0, 1.0))), make_episode(), 25.0 * DEG)


@pytest.mark.parametrize(
    ("phase", "limit"), [(int(STANCE), 25.0), (int(FLIGHT), 50.0), (int(LANDED), 50.0)], ids=["stance", "air", "landed"]
)
def test_hard_impact_has_a_limit_for_stance_and_one_for_the_rest(phase, limit):
    task = make_episode(phase=phase)
    for acc, hard in ((limit - 0.1, False), (limit + 0.1, True), (-limit - 0.1, False)):
        falling = make_view(lin_vel=(0.0, 0.0, -1.0), lin_acc=(0.0, 0.0, acc))
        assert holds("hard_impact", falling, task, 25.0, 50.0) is hard


def test_no_jump_within_the_time_or_at_rest_for_too_long():
    view = make_view()
    assert not holds("no_jump", view, make_episode(steps=210, command_step=30), 180.0, 60.0)
    assert holds("no_jump", view, make_episode(steps=211, command_step=30), 180.0, 60.0)
    assert not holds("no_jump", view, make_episode(steps=100, command_step=30, idle_steps=60), 180.0, 60.0)
    assert holds("no_jump", view, make_episode(steps=100, command_step=30, idle_steps=61), 180.0, 60.0)
    for phase in (FLIGHT, LANDED):
        assert not holds("no_jump", view, make_episode(phase=phase, steps=999, idle_steps=99), 180.0, 60.0)
    assert not holds("no_jump", view, make_episode(steps=20, command_step=30, idle_steps=99), 180.0, 60.0)


@pytest.mark.parametrize("flag", [1 << bit for bit in range(8)])
def test_any_collision_ends_the_episode(flag):
    assert holds("collided", make_view(collisions=flag), make_episode())
    assert not holds("collided", make_view(), make_episode())


def test_early_takeoff():
    jumped = {"phase": FLIGHT, "command_step": 30}
    assert holds("early_takeoff", make_view(), make_episode(took_off=1, steps=29, **jumped))
    assert not holds("early_takeoff", make_view(), make_episode(took_off=1, steps=30, **jumped))
    assert not holds("early_takeoff", make_view(), make_episode(took_off=0, steps=29, **jumped))
