"""Variants of the vertical jump, each without one of the ideas that make it learn."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

from jumper_warp.tasks.cfg import TaskCfg
from kernels.jump import rewards


def without_estimate(task: TaskCfg) -> TaskCfg:
    """Return the task that rewards the height of a jump at its apex only, not its ballistic estimate before.

    Raises ValueError for a task without this term.
    """
    if rewards.estimated_jump_height not in [term.func for term in task.terms]:
        raise ValueError(f"{task.name} has no term {rewards.estimated_jump_height.key}")
    terms = (replace(term, weight=0.0) if term.func is rewards.estimated_jump_height else term for term in task.terms)
    return replace(task, terms=tuple(terms))


def without_reference_states(task: TaskCfg) -> TaskCfg:
    """Return the task whose episodes all begin standing: none in flight, at touchdown or landed."""
    return replace(task, reset=replace(task.reset, standing=0.8, default=0.2, in_flight=0.0, touchdown=0.0))


def without_curriculum(task: TaskCfg) -> TaskCfg:
    """Return the task with its last level only."""
    return replace(task, levels=task.levels[-1:])


ABLATIONS: dict[str, Callable[[TaskCfg], TaskCfg]] = {
    "without_estimate": without_estimate,
    "without_reference_states": without_reference_states,
    "without_curriculum": without_curriculum,
}
