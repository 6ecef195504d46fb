"""Copies and pickles of tasks."""

import copy
import json
import multiprocessing
import pickle
import sys
from concurrent.futures import ProcessPoolExecutor

import pytest

from hold_height import hold_height
from jumper_warp.registry import TASKS, load_task_module, make_task
from jumper_warp.tasks.saving import task_to_json

COPIES = {"copy": copy.copy, "deepcopy": copy.deepcopy, "pickle": lambda task: pickle.loads(pickle.dumps(task))}
USER_TASK = """
import dataclasses
import warp as wp
from jumper_warp.kernels.jump.state import JumpState
from jumper_warp.kernels.mdp.view import RobotView
from jumper_warp.registry import make_task
from jumper_warp.tasks.terms import RewardTerm

@wp.func
def low(robot: RobotView, state: JumpState) -> float:
    return -robot.height

def make():
    task = make_task("vertical-jump")
    return dataclasses.replace(task, name="low-jump", rewards=(*task.rewards, RewardTerm(low, weight=2.0)))
"""


def spawned():
    """Return an executor of one new process; a task that cannot be unpickled there breaks it."""
    return ProcessPoolExecutor(1, multiprocessing.get_context("spawn"))


def content(task):
    """Return the saved JSON of a task as text."""
    return json.dumps(task_to_json(task))


@pytest.mark.parametrize("how", COPIES)
@pytest.mark.parametrize("make", [*(lambda name=name: make_task(name) for name in TASKS), hold_height],
                         ids=[*TASKS, "hold-height"])  # fmt: skip
def test_copy_equals_the_task(make, how):
    task = make()
    same = COPIES[how](task)
    assert same is not task and same == task and hash(same) == hash(task)
    assert content(same) == content(task)
    assert same.params.names == task.params.names and same.params.values == task.params.values


def test_task_reaches_a_spawned_process():
    task = make_task("velocity-flat")
    with spawned() as process:
        assert process.submit(copy.copy, task).result() == task
        assert process.submit(content, task).result() == content(task)


def is_imported(module):
    """Return whether this process has imported a module."""
    return module in sys.modules


def last_reward(task):
    """Return the name of a task's last reward."""
    return task.rewards[-1].name


def test_task_of_a_file_reaches_a_process_that_has_not_imported_the_file(tmp_path, monkeypatch):
    (tmp_path / "low_jump_task.py").write_text(USER_TASK)
    module = load_task_module(str(tmp_path / "low_jump_task.py"))
    monkeypatch.setitem(sys.modules, "low_jump_task", module)  # removes it after the test
    with spawned() as process:
        assert not process.submit(is_imported, "low_jump_task").result()
        assert process.submit(last_reward, module.make()).result() == "low"
