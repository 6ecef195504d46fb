"""Copies and pickles of tasks; Python pickles a task when it starts a process with it. Files never contain pickles."""

import copy
import json
import pickle

import pytest

from hold_height import hold_height
from jumper_warp.registry import TASKS, make_task
from jumper_warp.tasks.saving import task_to_json

COPIES = {"copy": copy.copy, "deepcopy": copy.deepcopy, "pickle": lambda task: pickle.loads(pickle.dumps(task))}


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
