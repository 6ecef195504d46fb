"""The jump tasks as data: curricula of goals and starts, and the tasks on Mars."""

import dataclasses

import pytest

from jumper_warp.registry import make_task
from jumper_warp.robot.motors import loose_filter, vertical_jump_filter

STARTS = ((0.22, 0.35), (0.22, 0.45))  # [m] base heights


@pytest.mark.parametrize("name", ["vertical-jump", "horizontal-jump", "horizontal-jump-standing", "vertical-jump-mars"])
def test_each_goal_level_has_the_easier_and_then_the_harder_starts(name):
    levels = make_task(name).levels
    for easier, harder in zip(levels[0::2], levels[1::2], strict=True):
        assert dataclasses.replace(easier, base_height=STARTS[1]) == harder and easier.base_height == STARTS[0]


def test_goals_in_all_directions_are_elliptical_and_grow_with_the_level():
    task = make_task("horizontal-jump-standing")
    reaches = [(level.goal_upper[0], level.goal_upper[1], -level.goal_lower[0]) for level in task.levels[2::2]]
    assert all(level.elliptical for level in task.levels[2:])
    assert reaches == sorted(reaches) and all(
        reach > least
        for reach, least in zip(reaches[-1], (1.2, 0.8, 0.8), strict=True)  # [m] ahead, aside, back
    )


@pytest.mark.parametrize("name", ["vertical-jump-mars", "horizontal-jump-mars"])
def test_mars_has_its_gravity_full_torque_and_a_loose_variant_with_higher_goals(name):
    task, loose = make_task(name), make_task(f"{name}-loose")
    kind = task.motors.transversal
    assert (task.gravity, kind.saturation, kind.kp) == (3.71, 24.8, 20.0)
    assert task.command_filter.horizon == vertical_jump_filter().horizon and loose.command_filter == loose_filter()
    axis, paper = (2, 3.1) if name.startswith("vertical") else (0, 3.9)  # z or x, [m]
    assert loose.levels[-1].goal_upper[axis] > paper
