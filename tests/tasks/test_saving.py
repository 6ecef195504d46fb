import copy
import dataclasses
import json
import math
import random
import sys
from typing import Any

import pytest
import warp as wp

import hold_height
from json_helpers import places
from jumper_warp.kernels.jump import rewards
from jumper_warp.kernels.jump.state import JumpState
from jumper_warp.kernels.mdp.view import RobotView
from jumper_warp.registry import TASKS, make_task
from jumper_warp.tasks.cfg import TaskCfg
from jumper_warp.tasks.saving import (
    MAX_ENTRIES,
    OPTIONAL,
    TaskError,
    name_of,
    parameterless,
    task_from_json,
    task_to_json,
)
from jumper_warp.tasks.terms import RewardTerm

JUMP = "jumper_warp.kernels.jump"


@wp.func
def rest(robot: RobotView, state: Any, speed: float, spin: float) -> float:
    """Another rest than the project's, with the same numbers."""
    return speed + spin


THIS = sys.modules[__name__]


def saved(task):
    """A task as a file holds it."""
    return json.loads(json.dumps(task_to_json(task)))


@pytest.mark.parametrize("name", list(TASKS))
def test_every_task_comes_back(name):
    task = make_task(name)
    assert task_from_json(saved(task)) == task


def test_task_of_a_user_comes_back_with_its_module_only():
    task = hold_height.hold_height()
    assert task_from_json(saved(task), [hold_height]) == task
    with pytest.raises(TaskError, match=r"task.state needs 'hold_height:HoldState': name the file .* --task-module"):
        task_from_json(saved(task))


def with_own_rest():
    """The vertical jump with this file's `rest` in place of the project's."""
    task = make_task("vertical-jump")
    mine = RewardTerm(rest, 20.0, speed=0.1, spin=0.5)
    return dataclasses.replace(task, rewards=tuple(mine if t.name == "rest" else t for t in task.rewards))


def test_function_of_a_user_is_never_taken_for_the_projects_of_the_same_name():
    task = with_own_rest()
    with pytest.raises(TaskError, match=rf"task.rewards\[9\] needs '{__name__}:rest': name the file"):
        task_from_json(saved(task))
    found = {term.name: term.func for term in task_from_json(saved(task), [THIS]).rewards}
    assert found["rest"] is rest and found["rest"] is not rewards.rest


def test_module_that_is_loaded_but_was_not_named_is_not_looked_into():
    assert sys.modules["hold_height"] is hold_height
    content = saved(make_task("vertical-jump"))
    content["rewards"][0]["func"] = "hold_height:near_goal"
    with pytest.raises(TaskError, match="name the file that defines it with --task-module"):
        task_from_json(content, [THIS])


def test_module_without_the_function_is_told_so():
    content = saved(with_own_rest())
    content["rewards"][9]["func"] = f"{__name__}:sleep"
    with pytest.raises(TaskError, match="there is no such one here"):
        task_from_json(content, [THIS])


def test_sections_of_a_training_can_be_left_out_with_their_functions():
    task, content = with_own_rest(), saved(with_own_rest())
    content["critic"][0]["func"] = content["rewards"][0]["func"] = "elsewhere:unknown"
    expected = dataclasses.replace(task, rewards=(), critic=(), events=())
    assert task_from_json(content, leave_out=OPTIONAL) == expected
    content["policy"][0]["func"] = "elsewhere:unknown"
    with pytest.raises(TaskError, match=r"task.policy\[0\] needs 'elsewhere:unknown'"):
        task_from_json(content, leave_out=("rewards", "critic", "events", "policy"))


def local_func():
    @wp.func
    def inner(robot: RobotView, state: Any) -> float:
        return 1.0

    return inner


renamed = local_func()


@pytest.mark.parametrize("func", [local_func(), renamed])
def test_function_that_could_not_be_found_again_is_not_saved(func):
    task = dataclasses.replace(make_task("vertical-jump"), rewards=(RewardTerm(func, 1.0, name="mine"),))
    with pytest.raises(TaskError, match="cannot be saved: define it under this name at the top level"):
        task_to_json(task)


def test_function_of_a_program_has_the_name_of_its_file(monkeypatch):
    main = sys.modules["__main__"]
    monkeypatch.setattr(main, "rest", rest, raising=False)
    monkeypatch.setattr(main, "__file__", "/some/where/my_task.py", raising=False)
    monkeypatch.setattr(main, "__spec__", None)
    monkeypatch.setattr(rest.func, "__module__", "__main__")
    assert name_of(rest) == "my_task:rest"


@dataclasses.dataclass(frozen=True)
class Settings:
    value: Any = 1.0


@pytest.mark.parametrize("value", [math.nan, math.inf, {"a": 1.0}, [1.0], b"x", object()])
def test_setting_that_would_not_come_back_is_not_saved(value):
    with pytest.raises(TaskError):
        parameterless(Settings(value))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda t: t.update(version=2), "the task has version 2, this is version 3; commit c88f715 reads older ones"),
        (lambda t: t.pop("version"), "the task has version None, this is version 3; commit c88f715"),
        (lambda t: t.pop("terminations"), "task.terminations is missing"),
        (lambda t: t.update(wings=2), "task: unknown setting 'wings'"),
        (lambda t: t["rewards"][3].pop("weight"), r"task.rewards\[3\]: a reward needs a weight"),
        (lambda t: t["rewards"][0].update(fin=0.1), r"task.rewards\[0\]: .* unknown parameter 'fin'"),
        (lambda t: t["rewards"][0].pop("fine"), r"task.rewards\[0\]: .* parameter 'fine' is missing"),
        (lambda t: t["rewards"][0].update(name="a\nb"), "a name is of letters"),
        (lambda t: t["rewards"][0].update(once="yes"), r"task.rewards\[0\].once: expected bool, got 'yes'"),
        (lambda t: t["rewards"][0].update(weight=10**400), r"weight: must be finite, got a huge integer"),
        (lambda t: t["rewards"][0].update(func="jumper_warp.kernels.jump.state:JumpState"), "is not a @wp.func"),
        (lambda t: t["rewards"][0].update(func="jumper_warp.kernels.jump.rewards:wp"), "there is no such one here"),
        (lambda t: t["rewards"][0].update(func=f"{JUMP}.terminations:success", steps=1.0), "must return float"),
        (lambda t: t["rewards"][0].update(type="jumper_warp.tasks.terms:TerminationTerm"), "expected .* RewardTerm"),
        (lambda t: t["policy"][0].update(history=10**9), "history must be at most"),
        (lambda t: t["advance"].update(func="jumper_warp.kernels.mdp.view:load_view"), "must be annotated RobotView"),
        (lambda t: t.update(state="jumper_warp.kernels.mdp.env:Nothing"), "not a struct that counts steps"),
        (lambda t: t["levels"].append({"type": "jumper_warp.robot.motors:LimitsCfg", "lower": 0.0, "upper": 1.0}),
         r"task.levels\[6\]: .* needs struct and values"),
        (lambda t: t.update(levels=t["levels"] * MAX_ENTRIES), f"expected at most {MAX_ENTRIES} entries"),
        (lambda t: t["reset"].update(settings={"type": "jumper_warp.robot.motors:LimitsCfg", "lower": 0, "upper": 1}),
         "needs struct and values"),
        (lambda t: t["curriculum"].update(counts=None), "expected module:name, got None"),
        (lambda t: t.update(randomization={"gains": [0.5]}), "task.randomization.gains: expected 2 entries, got 1"),
        (lambda t: t["randomization"].update(redraw="never"), "task.randomization.redraw: must be one of"),
    ],
)  # fmt: skip
def test_what_is_no_task_is_refused(change, message):
    content = saved(make_task("vertical-jump"))
    change(content)
    with pytest.raises(TaskError, match=message):
        task_from_json(content)


def test_setting_that_is_not_saved_keeps_its_default():
    content = saved(make_task("vertical-jump"))
    del content["contact_force"], content["curriculum"]["promote_after"], content["reset"]["settings"]["tilt"]
    assert task_from_json(content) == make_task("vertical-jump")


# ---------------------------------------------------------------------- mutations


def deep(levels):
    """Lists and objects in each other."""
    value: Any = 1.0
    for i in range(levels):
        value = [value] if i % 2 else {"type": value}
    return value


VALUES = [
    None, True, False, 0, 1, -1, 2.5, -0.0, 1e308, -1e300, 1e-300, math.nan, math.inf, -math.inf, 10**30, 10**400,
    "", "x", "rest", "a\nb", "\ud800", "os:system", "os.path:join", "trap:func", f"{JUMP}.rewards:rest",
    f"{JUMP}.state:JumpState", "jumper_warp.kernels.mdp.env:Nothing", f"{JUMP}.rewards:wp", f"{JUMP}.rewards:",
    ":rest", "a:b:c", "jumper_warp.tasks.cfg:TaskCfg", "jumper_warp.tasks.terms:Term", "jumper_warp.tasks.cfg:Reset",
    "jumper_warp.tasks.terms:EventTerm", "jumper_warp.robot.description:RobotDescription",
    "jumper_warp.robot.parts:Motor", "jumper_warp.tasks.jump.cfg:GroundCfg", "jumper_warp.tasks.saving:Finder",
    [], [1], [1.0, 2.0], [[1.0]], ["a"] * 3, [None] * 5000, [{}] * 5000, {}, {"type": None}, {"a": 1}, {"type": "os:x"},
    {"type": "jumper_warp.tasks.jump.cfg:GroundCfg"}, {"func": f"{JUMP}.rewards:rest"}, {"a\nb": [math.nan]},
    deep(300), {"type": ["x"]}, {"type": {"type": "x"}},
]  # fmt: skip
KEYS = ["extra", "", "a\nb", "\ud800", "type", "func", "name", "self", "weight", "history", "settings", "version"]


def mutate(tree, rng):
    """Change, drop, add, double or swap one entry."""
    table, key = rng.choice(list(places(tree)))
    kind = rng.choice(["value", "value", "value", "scale", "drop", "add", "double", "swap"])
    if kind == "drop":
        del table[key]
    elif kind == "add" and isinstance(table, dict):
        table[rng.choice(KEYS)] = copy.deepcopy(rng.choice(VALUES))
    elif kind == "double" and isinstance(table, list):
        table.insert(key, copy.deepcopy(table[key]))
    elif kind == "swap":
        other, place = rng.choice(list(places(tree)))
        table[key] = copy.deepcopy(other[place])
    elif kind == "scale" and isinstance(table[key], int | float):
        table[key] = table[key] * rng.choice([-1.0, 0.0, 1e3, 1e300, 1e-300])
    else:
        table[key] = copy.deepcopy(rng.choice(VALUES))


@pytest.mark.parametrize("name", [*TASKS, "hold-height"])
def test_mutated_task_is_a_task_or_refused_in_one_line_and_nothing_is_imported(name, tmp_path, monkeypatch):
    (tmp_path / "trap.py").write_text("raise SystemExit('imported')")
    monkeypatch.syspath_prepend(tmp_path)
    task = hold_height.hold_height() if name == "hold-height" else make_task(name)
    modules = [hold_height] if name == "hold-height" else []
    content, rng = saved(task), random.Random(name)
    assert task_from_json(content, modules) == task
    loaded, refused = set(sys.modules), 0
    for _ in range(200):
        changed = copy.deepcopy(content)
        for _ in range(rng.choice([1, 1, 2, 4])):
            mutate(changed, rng)
        try:
            found = task_from_json(changed, modules)
        except TaskError as error:
            refused += 1
            assert len(str(error).splitlines()) == 1 and 0 < len(str(error)) < 500
            continue
        assert isinstance(found, TaskCfg) and all(math.isfinite(number) for number in found.params.values)
        assert len(found.observation_names) < 10**6
        assert task_from_json(json.loads(json.dumps(task_to_json(found), allow_nan=False)), modules) == found
    assert set(sys.modules) == loaded and 40 < refused < 200


@pytest.mark.parametrize("content", [None, [], "task", 3, math.nan, {}, {"version": 3}, deep(200), {"version": [2]}])
def test_what_is_no_object_is_refused(content):
    with pytest.raises(TaskError):
        task_from_json(content)


def test_state_of_another_task_is_refused():
    content = saved(hold_height.hold_height())
    content["state"] = "jumper_warp.kernels.jump.state:JumpState"
    with pytest.raises(TaskError, match=f"is for .*HoldState, not .*{JumpState.key}"):
        task_from_json(content, [hold_height])
