"""Saved tasks: round trips, refusals, and functions of users."""

import dataclasses
import json
import sys
from typing import Any

import pytest
import warp as wp

import hold_height
from jumper_warp.kernels.jump import rewards
from jumper_warp.kernels.mdp.view import RobotView
from jumper_warp.registry import TASKS, make_task
from jumper_warp.tasks.saving import OPTIONAL, TaskError, name_of, task_from_json, task_to_json
from jumper_warp.tasks.terms import RewardTerm


@wp.func
def base_at_rest(robot: RobotView, state: Any, std_lin_vel: float, std_ang_vel: float) -> float:
    """A function with the name and numbers of the project's `base_at_rest`."""
    return std_lin_vel + std_ang_vel


THIS = sys.modules[__name__]


def saved(task):
    """Return a task as the JSON data that a file holds."""
    return json.loads(json.dumps(task_to_json(task)))


@pytest.mark.parametrize("name", list(TASKS))
def test_every_task_is_equal_after_saving_and_loading(name):
    task = make_task(name)
    assert task_from_json(saved(task)) == task


def test_task_of_a_user_loads_only_with_its_module():
    task = hold_height.hold_height()
    assert task_from_json(saved(task), [hold_height]) == task
    with pytest.raises(TaskError, match=r"task.state needs 'hold_height:HoldState': pass the file .* --task-module"):
        task_from_json(saved(task))


def jump_with_user_reward():
    """Return the vertical jump with this file's `base_at_rest` in place of the project's, at rewards[9]."""
    task = make_task("vertical-jump")
    mine = RewardTerm(base_at_rest, 20.0, std_lin_vel=0.1, std_ang_vel=0.5)
    return dataclasses.replace(task, rewards=tuple(mine if t.name == "base_at_rest" else t for t in task.rewards))


def test_function_of_a_user_is_not_confused_with_the_projects_of_the_same_name():
    task = jump_with_user_reward()
    with pytest.raises(TaskError, match=rf"task.rewards\[9\].func needs '{__name__}:base_at_rest': pass the file"):
        task_from_json(saved(task))
    functions = {term.name: term.func for term in task_from_json(saved(task), [THIS]).rewards}
    assert functions["base_at_rest"] is base_at_rest and base_at_rest is not rewards.base_at_rest


def test_sections_for_training_can_be_left_out_with_their_functions():
    task, content = jump_with_user_reward(), saved(jump_with_user_reward())
    content["observations"]["critic"][0]["func"] = content["rewards"][0]["func"] = "elsewhere:unknown"
    expected = dataclasses.replace(
        task, rewards=(), observations=dataclasses.replace(task.observations, critic=()), events=()
    )
    assert task_from_json(content, leave_out=OPTIONAL) == expected
    content["observations"]["actor"][0]["func"] = "elsewhere:unknown"
    with pytest.raises(TaskError, match=r"task.observations.actor\[0\].func needs 'elsewhere:unknown'"):
        task_from_json(content, leave_out=("rewards", "critic", "events", "actor"))


def test_function_of_main_is_saved_under_the_stem_of_its_file(monkeypatch):
    main = sys.modules["__main__"]
    monkeypatch.setattr(main, "base_at_rest", base_at_rest, raising=False)
    monkeypatch.setattr(main, "__file__", "/some/where/my_task.py", raising=False)
    monkeypatch.setattr(main, "__spec__", None)
    monkeypatch.setattr(base_at_rest.func, "__module__", "__main__")
    assert name_of(base_at_rest) == "my_task:base_at_rest"


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda t: t.update(version=4), "the task has version 4, expected version 5; commit 7f5b55c3 reads version 4"),
        (lambda t: t["rewards"][0].update(fin=0.1), r"task.rewards\[0\]: .* unknown parameter 'fin'"),
    ],
)  # fmt: skip
def test_changed_json_that_is_no_task_is_refused(change, message):
    content = saved(make_task("vertical-jump"))
    change(content)
    with pytest.raises(TaskError, match=message):
        task_from_json(content)
