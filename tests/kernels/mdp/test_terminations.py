import math

import numpy as np
import pytest

from jump_helpers import DEG, Table, functions, make_episode, make_view, tilted_by
from jumper_warp.kernels.mdp import terminations

holds = Table(functions(terminations, "too_long diverged low_base tilted collided"), bool)
"""holds(name, view, episode, **numbers): whether a termination holds."""


def test_too_long_holds_from_its_number_of_policy_steps_on():
    for steps, over in ((1199, False), (1200, True)):
        assert holds("too_long", make_view(), make_episode(steps=steps), steps=1200.0) is over


@pytest.mark.parametrize(
    ("robot", "diverged"),
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
def test_diverged_holds_beyond_speed_limits_and_for_nonfinite_values(robot, diverged):
    assert holds("diverged", make_view(**robot), make_episode()) is diverged


def test_low_base_compares_the_height_above_the_ground_below():
    for z, low in ((0.21, False), (0.19, True)):
        assert holds("low_base", make_view(pos=(0.0, 0.0, z)), make_episode(), height=0.2) is low
        assert holds("low_base", make_view(pos=(0.0, 0.0, 1.0), height=z), make_episode(), height=0.2) is low


@pytest.mark.parametrize("axis", [(1.0, 0.0, 0.0), (0.0, -1.0, 0.0), (0.6, 0.8, 0.0)])
def test_tilted_holds_beyond_its_angle_about_any_horizontal_axis(axis):
    assert not holds("tilted", make_view(**tilted_by(24.9 * DEG, axis)), make_episode(), angle=25.0 * DEG)
    assert holds("tilted", make_view(**tilted_by(25.1 * DEG, axis)), make_episode(), angle=25.0 * DEG)
    assert holds("tilted", make_view(**tilted_by(180.0 * DEG, axis)), make_episode(), angle=25.0 * DEG)


def test_turning_about_the_vertical_is_no_tilt():
    assert not holds("tilted", make_view(**tilted_by(2.0, (0.0, 0.0, 1.0))), make_episode(), angle=25.0 * DEG)


@pytest.mark.parametrize("flag", [1 << bit for bit in range(8)])
def test_collided_holds_for_every_collision_flag(flag):
    assert holds("collided", make_view(collisions=flag), make_episode())
    assert not holds("collided", make_view(), make_episode())
