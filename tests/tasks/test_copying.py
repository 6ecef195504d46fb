"""Copies and pickles of tasks."""

import copy
import dataclasses
import json
import multiprocessing
import pickle
import subprocess
import sys
from typing import Any

import pytest
import warp as wp

from hold_height import hold_height
from jumper_warp.kernels.mdp.view import RobotView
from jumper_warp.registry import TASKS, load_task_module, make_task
from jumper_warp.tasks.saving import task_to_json
from jumper_warp.tasks.terms import RewardTerm

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
    return -robot.base.pos[2]

def make():
    task = make_task("vertical-jump")
    return dataclasses.replace(task, name="low-jump", rewards=(*task.rewards, RewardTerm(low, weight=2.0)))
"""


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


@pytest.mark.parametrize("how", ["deepcopy", "pickle"])
def test_terms_of_a_deep_copy_are_separate(how):
    task = make_task("vertical-jump")
    same = COPIES[how](task)
    weight = task.rewards[0].weight
    same.rewards[0].numbers["weight"] = weight + 1.0
    assert task.rewards[0].weight == weight


def test_task_reaches_a_spawned_process():
    task = make_task("velocity-flat")
    with multiprocessing.get_context("spawn").Pool(1) as pool:
        returned = pool.apply(copy.copy, [task])
        assert pool.apply(content, [task]) == content(task)
    assert returned == task


def test_task_of_a_file_is_unpickled_where_the_file_is_not_imported(tmp_path, monkeypatch):
    (tmp_path / "low_jump_task.py").write_text(USER_TASK)
    module = load_task_module(str(tmp_path / "low_jump_task.py"))
    monkeypatch.setitem(sys.modules, "low_jump_task", module)  # removes it after the test
    (tmp_path / "task.pickle").write_bytes(pickle.dumps(module.make()))
    code = "import pickle, sys; print(*(t.name for t in pickle.load(open(sys.argv[1], 'rb')).rewards))"
    done = subprocess.run(
        [sys.executable, "-c", code, tmp_path / "task.pickle"], capture_output=True, text=True, timeout=120
    )
    assert done.returncode == 0 and done.stdout.split()[-1] == "low", done.stderr


def test_function_that_is_not_at_the_top_level_can_be_copied_but_not_pickled():
    @wp.func
    def inner(robot: RobotView, state: Any) -> float:
        return 1.0

    task = make_task("vertical-jump")
    task = dataclasses.replace(task, rewards=(RewardTerm(inner, weight=1.0),))
    assert copy.deepcopy(task) == copy.copy(task) == task
    with pytest.raises(pickle.PicklingError, match=r"inner cannot be pickled: define it .* top level"):
        pickle.dumps(task)
