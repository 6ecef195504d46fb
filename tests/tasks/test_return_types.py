"""A term whose function returns another type is refused with the function's file and line."""

import dataclasses
import inspect
from typing import Any

import pytest
import warp as wp

from jumper_warp.kernels.mdp.view import RobotView
from jumper_warp.registry import make_task
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


def test_a_function_that_may_end_without_return_is_refused():
    with pytest.raises(InputError) as refusal:
        dataclasses.replace(make_task("vertical-jump"), rewards=(RewardTerm(called, 1.0),))
    where = "RewardTerm called: height_if_high"
    assert str(refusal.value) == f"{place(height_if_high)}{where} ends without `return` in some cases, add one"
