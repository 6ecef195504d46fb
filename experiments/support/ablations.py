"""Variants of the vertical jump, each without one of the ideas that make it learn."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

from jumper_warp.tasks.cfg import TaskCfg


def without_estimate(task: TaskCfg) -> TaskCfg:
    """Return the task that rewards the height of a jump at its apex only, not its ballistic estimate before.

    Raises ValueError for a task without this term.
    """
    return task.with_terms("rewards", estimated_jump_height={"weight": 0.0})


def without_reference_states(task: TaskCfg) -> TaskCfg:
    """Return the task whose episodes all begin standing: none in flight, at touchdown or landed."""
    settings = replace(task.reset.settings, standing=0.8, default=0.2, in_flight=0.0, touchdown=0.0, pushing=0.0)
    return replace(task, reset=replace(task.reset, settings=settings))


def without_curriculum(task: TaskCfg) -> TaskCfg:
    """Return the task with its last level only."""
    return replace(task, levels=task.levels[-1:])


ABLATIONS: dict[str, Callable[[TaskCfg], TaskCfg]] = {
    "without_estimate": without_estimate,
    "without_reference_states": without_reference_states,
    "without_curriculum": without_curriculum,
}
