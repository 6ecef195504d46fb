"""The jump tasks as data: curricula of goals and starts, and the tasks on Mars."""

import dataclasses

import pytest

from jumper_warp.registry import make_task

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
