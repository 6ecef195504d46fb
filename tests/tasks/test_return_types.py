"""A term whose function returns another type is refused with the function's file and line."""

import dataclasses
import inspect
from typing import Any

import pytest
import warp as wp

from jumper_warp.kernels.jump.state import JumpState
from jumper_warp.kernels.mdp.view import RobotView
from jumper_warp.registry import make_task
from jumper_warp.tasks.cfg import Handover
from jumper_warp.tasks.terms import Advance, ObservationTerm, RewardTerm, TerminationTerm
from jumper_warp.utils.errors import InputError


# Functions of terms, each named for the type that it returns, whose annotation is right, absent or float.
@wp.func
def whole(robot: RobotView, state: Any) -> int:
    return 1


@wp.func
def whole_as_float(robot: RobotView, state: Any) -> float:
    return 1


@wp.func
def nothing_unannotated(robot: RobotView, state: Any):
    x = 1.0  # noqa: F841


def place(func):
    """Return file and line of a function of this file."""
    return f"test_return_types.py:{inspect.unwrap(func.func).__code__.co_firstlineno}: "


@pytest.mark.parametrize(
    ("kind", "func", "message"),
    [
        (RewardTerm, whole, "RewardTerm whole: the function must return float, its annotation is int"),
        (TerminationTerm, whole, "the function must return bool, its annotation is int"),
        (ObservationTerm, whole, "the function must return float or a vector, its annotation is int"),
        (ObservationTerm, nothing_unannotated, "needs an annotation of its return type, float or a vector"),
        (Advance, whole, "the function must return the state, its annotation is int"),
    ],
)
def test_wrong_annotation_is_refused_at_the_definition(kind, func, message):
    values = {"weight": 1.0} if kind is RewardTerm else {}
    with pytest.raises(InputError) as refusal:
        kind(func, **values)
    assert str(refusal.value).startswith(place(func)) and message in str(refusal.value)


@pytest.mark.parametrize(("func", "returned"), [(whole_as_float, "int32"), (nothing_unannotated, "nothing")])
def test_wrong_value_without_annotation_is_refused_by_the_task(func, returned):
    term = RewardTerm(func, 1.0)
    with pytest.raises(InputError) as refusal:
        dataclasses.replace(make_task("vertical-jump"), rewards=(term,))
    message = f"RewardTerm {func.key}: the function must return float, it returns {returned}"
    assert str(refusal.value) == place(func) + message


@wp.func
def may_switch(robot: RobotView, state: JumpState, requested: bool):
    x = 1.0  # noqa: F841


@wp.func
def begin_jump(robot: RobotView, state: JumpState) -> JumpState:
    return state


def test_handover_whose_condition_returns_nothing_is_refused():
    jump = make_task("vertical-jump")
    with pytest.raises(InputError) as refusal:
        Handover(jump, jump, may_switch, begin_jump)
    subject = "handover from vertical-jump to vertical-jump, when may_switch"
    assert str(refusal.value) == f"{place(may_switch)}{subject}: the function must return bool, it returns nothing"


@wp.func
def advance_late(robot: RobotView, state: JumpState) -> JumpState:
    new = state
    new.steps = state.steps + 1
    if state.steps > 10:
        return new


@wp.func
def height_if_high(robot: RobotView) -> float:
    if robot.height > 1.0:
        return robot.height
    elif robot.height > 0.5:
        x = 1.0  # noqa: F841
    else:
        return 0.0


@wp.func
def called(robot: RobotView, state: Any) -> float:
    return height_if_high(robot)


@wp.func
def complete(robot: RobotView, state: Any) -> float:
    if robot.height > 1.0:
        return 1.0
    elif robot.height > 0.5:
        return 0.5
    else:
        return 0.0


@pytest.mark.parametrize(
    ("changes", "func", "where"),
    [
        ({"advance": Advance(advance_late)}, advance_late, "Advance advance_late: advance_late"),
        ({"rewards": (RewardTerm(called, 1.0),)}, height_if_high, "RewardTerm called: height_if_high"),
    ],
)
def test_a_function_that_may_end_without_return_is_refused(changes, func, where):
    with pytest.raises(InputError) as refusal:
        dataclasses.replace(make_task("vertical-jump"), **changes)
    assert str(refusal.value) == f"{place(func)}{where} ends without `return` in some cases, add one"


def test_a_return_in_every_branch_is_complete():
    dataclasses.replace(make_task("vertical-jump"), rewards=(RewardTerm(complete, 1.0),))
