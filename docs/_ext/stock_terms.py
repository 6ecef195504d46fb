"""Warp functions of `jumper_warp.mdp` and of the project's tasks: rewards, terminations, observations and events."""

from __future__ import annotations

import importlib
import inspect
from collections.abc import Callable, Sequence
from functools import cache, partial
from types import ModuleType
from typing import Any

import warp as wp

from jumper_warp import mdp
from jumper_warp.registry import TASKS, make_task

SPACES: dict[str, ModuleType] = {
    name: getattr(mdp, name) for name in ("rewards", "terminations", "observations", "events")
}
"""Namespaces of stock terms."""
TASK_KINDS = {"jump": "jumps", "velocity": "walks", "attitude": "turns"}
"""Words for the skills, by the packages of `jumper_warp.kernels` with their terms."""
EMPTY = inspect.Signature.empty


def is_term(space: str, func: Any) -> bool:
    """Return whether a Warp function has the signature of a term, such as a reward; space: key of `SPACES`."""
    signature = inspect.signature(func.func)
    names, returns = list(signature.parameters), signature.return_annotation
    if space == "events":
        return names[:2] == ["robot", "rng"] and returns is EMPTY
    if space == "observations":
        return names in (["robot", "state"], ["robot", "world"], ["arrays", "ground", "world"])
    return (
        names[:2] == ["robot", "state"]
        and returns in {"rewards": (float, wp.float32), "terminations": (bool, wp.bool)}[space]
    )


def functions_of(module: ModuleType, fits: Callable[[Any], bool]) -> dict[str, Any]:
    """Return the Warp functions that a module defines and for which `fits` returns True, by name."""
    defined = {name: value for name, value in vars(module).items() if isinstance(value, wp.Function)}
    return {name: func for name, func in defined.items() if func.func.__module__ == module.__name__ and fits(func)}


def stock_terms(space: str) -> dict[str, Any]:
    """Return the stock terms of a namespace by full name, such as `jumper_warp.mdp.rewards.action_rate`."""
    terms = functions_of(SPACES[space], lambda func: is_term(space, func))
    return {f"{mdp.__name__}.{space}.{name}": func for name, func in terms.items()}


def helpers(space: str) -> dict[str, Any]:
    """Return the auxiliary functions of a namespace of stock terms, which are no terms, by full name."""
    others = functions_of(SPACES[space], lambda func: not is_term(space, func))
    return {f"{mdp.__name__}.{space}.{name}": func for name, func in others.items()}


def task_terms(space: str, kind: str) -> dict[str, Any]:
    """Return the terms of a namespace that only the project's tasks of one kind can use, by full name."""
    if space == "events":
        return {}
    names = [f"{kind}.{space}", *(["jump.paper"] if kind == "jump" else [])]
    terms: dict[str, Any] = {}
    for module in (importlib.import_module(f"jumper_warp.kernels.{name}") for name in names):
        found = functions_of(module, partial(is_term, space))
        terms |= {f"{module.__name__}.{name}": func for name, func in found.items()}
    return terms


@cache
def tasks_by_kind() -> dict[str, list[str]]:
    """Return the names of the project's tasks, grouped by the keys of `TASK_KINDS`."""
    kinds: dict[str, list[str]] = {}
    for name in TASKS:
        kinds.setdefault(make_task(name).state.cls.__module__.split(".")[2], []).append(name)
    return kinds


def words_for_tasks(names: Sequence[str]) -> str:
    """Describe a list of tasks in words; all tasks of a kind together are named "all jumps"."""
    if set(names) == set(TASKS):
        return "all tasks"
    words = []
    for kind, members in tasks_by_kind().items():
        used = [name for name in members if name in names]
        words += [f"all {TASK_KINDS[kind]}"] if used == members != used[:1] else [f"`{name}`" for name in used]
    return ", ".join(words)


def tasks_by_function() -> dict[Any, list[str]]:
    """Return the names of the project's tasks that use a function in a term, by function."""
    used: dict[Any, list[str]] = {}
    for name in TASKS:
        task = make_task(name)
        terms = [*task.rewards, *task.terminations, *task.observations.actor, *task.observations.critic]
        terms += [*task.randomization.events(), *task.events]
        for func in dict.fromkeys(term.func for term in terms):
            used.setdefault(func, []).append(name)
    return used
