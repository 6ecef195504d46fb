"""Tasks as JSON, and back. Functions and types are saved as `module:name`; reading one imports nothing.

They are looked up in the project's own modules and in those that a user has named, nowhere else.
"""

from __future__ import annotations

import dataclasses
import sys
from collections.abc import Iterable
from types import ModuleType, UnionType
from typing import Any, Union, get_args, get_origin, get_type_hints

import warp as wp

from jumper_warp.tasks.cfg import TaskCfg
from jumper_warp.tasks.terms import RewardTerm, Term

VERSION = 2
"""Of the form in which tasks are saved."""
OWN = ("jumper_warp.tasks.", "jumper_warp.robot.", "kernels.")
"""Beginnings of the names of the project's modules that a task may name."""


class TaskError(ValueError):
    """A saved task that cannot be restored. The message is one line."""


def name_of(thing: Any) -> str:
    """Return `module:name` of a Warp function, a struct or a class. Raises TaskError for one that cannot be found."""
    python = thing.func if isinstance(thing, wp.Function) else getattr(thing, "cls", thing)
    if "<locals>" in python.__qualname__:
        raise TaskError(f"{python.__qualname__} cannot be saved: define it at the top level of a module")
    return f"{python.__module__}:{python.__qualname__}"


def plain(value: Any) -> Any:
    """Return a configuration as JSON can hold it."""
    if isinstance(value, Term):
        options = {key: plain(option) for key, option in value.options.items()}
        return {
            "type": name_of(type(value)),
            "func": name_of(value.func),
            "name": value.name,
            **value.numbers,
            **options,
        }
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        fields = {spec.name: plain(getattr(value, spec.name)) for spec in dataclasses.fields(value)}
        return {"type": name_of(type(value)), **fields}
    if isinstance(value, wp.Function) or hasattr(value, "cls"):
        return name_of(value)
    if isinstance(value, tuple | list):
        return [plain(v) for v in value]
    return value


def task_to_json(task: TaskCfg) -> dict[str, Any]:
    """Return a task as JSON can hold it. Raises TaskError: a function of it cannot be found again."""
    return {"version": VERSION, **plain(task)}


class Finder:
    """Looks functions and types up by name."""

    def __init__(self, modules: Iterable[ModuleType] = ()) -> None:
        """modules: those that the user has named, besides the project's own."""
        self.modules = {module.__name__: module for module in modules}

    def __call__(self, name: Any, where: str) -> Any:
        """Return a Warp function, struct, dataclass or kind of term by `module:name`. Raises TaskError."""
        if not isinstance(name, str) or name.count(":") != 1:
            raise TaskError(f"{where}: expected module:name, got {name!r:.60}")
        module_name, _, attribute = name.partition(":")
        module = self.modules.get(module_name)
        if module is None and module_name.startswith(OWN):
            module = sys.modules.get(module_name)
        found = getattr(module, attribute, None)
        usable = isinstance(found, wp.Function) or hasattr(found, "cls")
        if isinstance(found, type):
            usable = dataclasses.is_dataclass(found) or issubclass(found, Term)
        if not usable:
            own = module_name.startswith(OWN)
            hint = "this version has no such one" if own else "name the file that defines it with --task-module"
            raise TaskError(f"{where} needs {name!r:.80}: {hint}")
        return found


def task_from_json(saved: Any, modules: Iterable[ModuleType] = (), *, rewards: bool = True) -> TaskCfg:
    """Return a saved task.

    Args:
        saved: What `task_to_json` gave.
        modules: That the user has named.
        rewards: Whether its reward terms are wanted; playing and measuring a policy need none.

    Raises:
        TaskError: It is not a task of this version, or a function is in none of the modules.
    """
    if not isinstance(saved, dict):
        raise TaskError("the task must be a JSON object")
    if saved.get("version") != VERSION:
        raise TaskError(f"the task has version {saved.get('version')!r:.20}, this is version {VERSION}")
    content = {key: value for key, value in saved.items() if key not in ("version", "type")}
    if not rewards:
        content["rewards"] = []
    try:
        return _build(TaskCfg, content, "task", Finder(modules))
    except TaskError:
        raise
    except (ValueError, TypeError, KeyError, AttributeError) as error:
        raise TaskError(f"task: {' '.join(str(error).split())[:200]}") from error


def _build(kind: type, saved: dict[str, Any], where: str, find: Finder) -> Any:
    """Return a dataclass of a kind from its saved fields; fields that are missing have their defaults."""
    hints = get_type_hints(kind)
    fields = {spec.name for spec in dataclasses.fields(kind)}
    unknown = sorted(set(saved) - fields)
    if unknown:
        raise TaskError(f"{where}: unknown setting {unknown[0]!r:.60}")
    return kind(**{name: _value(value, hints[name], f"{where}.{name}", find) for name, value in saved.items()})


def _value(saved: Any, hint: Any, where: str, find: Finder) -> Any:
    """Return a saved value as what the hint of its field asks for."""
    if get_origin(hint) in (Union, UnionType):
        kinds = get_args(hint)
        if saved is None and type(None) in kinds:
            return None
        hint = next(kind for kind in kinds if kind is not type(None))
    if isinstance(saved, dict):
        return _object(saved, hint, where, find)
    if hint is wp.Function or (hint is Any and isinstance(saved, str)):
        return find(saved, where)
    if isinstance(saved, list):
        inner = get_args(hint)
        if get_origin(hint) is not tuple:
            raise TaskError(f"{where}: expected no list")
        if len(inner) == 2 and inner[1] is Ellipsis:
            return tuple(_value(v, inner[0], f"{where}[{i}]", find) for i, v in enumerate(saved))
        if len(inner) != len(saved):
            raise TaskError(f"{where}: expected {len(inner)} entries, got {len(saved)}")
        return tuple(_value(v, k, f"{where}[{i}]", find) for i, (v, k) in enumerate(zip(saved, inner, strict=True)))
    return _scalar(saved, hint, where)


def _object(saved: dict[str, Any], hint: Any, where: str, find: Finder) -> Any:
    """Return a saved term or dataclass; of the kind that the field asks for, unless it names another."""
    kind = hint if "type" not in saved and dataclasses.is_dataclass(hint) else find(saved.get("type"), where)
    content = {key: value for key, value in saved.items() if key != "type"}
    if isinstance(kind, type) and issubclass(kind, Term):
        func = find(content.pop("func", None), where)
        options = {key: find(value, where) if isinstance(value, str) and ":" in value else value
                   for key, value in content.items()}  # fmt: skip
        if kind is RewardTerm and "weight" not in options:
            raise TaskError(f"{where}: a reward needs a weight")
        return kind(func, **options)
    if not (isinstance(kind, type) and dataclasses.is_dataclass(kind)):
        raise TaskError(f"{where}: {saved.get('type')!r:.60} is not a kind of setting")
    return _build(kind, content, where, find)


def _scalar(saved: Any, hint: Any, where: str) -> Any:
    """Return a number, string or flag, checked against the hint."""
    kinds = {float: (float, int), int: (int,), str: (str,), bool: (bool,)}.get(hint)
    if get_args(hint) and not kinds:  # a Literal
        if saved not in get_args(hint):
            raise TaskError(f"{where}: must be one of {get_args(hint)}, got {saved!r:.60}")
        return saved
    if kinds is None:
        if saved is None or isinstance(saved, bool | int | float | str):
            return saved
        raise TaskError(f"{where}: cannot be read, got {saved!r:.60}")
    if isinstance(saved, bool) != (hint is bool) or not isinstance(saved, kinds):
        raise TaskError(f"{where}: expected {hint.__name__}, got {saved!r:.60}")
    return hint(saved)
