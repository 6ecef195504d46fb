"""Conversion of tasks to JSON and back. Functions and types are saved as `module:name`.

Names are resolved in the project's modules and in those that the user passes; no other module is imported for a name.
"""

from __future__ import annotations

import dataclasses
import functools
import importlib
import pkgutil
from collections.abc import Collection, Iterable
from pathlib import Path
from types import ModuleType, UnionType
from typing import Any, Union, get_args, get_origin, get_type_hints

import warp as wp

import jumper_warp.kernels
import jumper_warp.robot
import jumper_warp.tasks
from jumper_warp.tasks.cfg import Handover, TaskCfg
from jumper_warp.tasks.copying import Struct, top_level
from jumper_warp.tasks.terms import Term
from jumper_warp.utils.checks import FLOAT32_MAX, in_float32, version_error
from jumper_warp.utils.errors import InputError
from jumper_warp.utils.files import Json
from jumper_warp.utils.sources import with_neighbours

VERSION = 5  # of the saved format
LAST_OF_VERSION_4 = "7f5b55c3"  # Last commit that reads version 4
OPTIONAL = ("rewards", "critic", "events")  # sections that only training needs


class TaskError(InputError):
    """Error: a saved task cannot be restored, or a task cannot be saved. The message is one line."""


# ---------------------------------------------------------------------- to JSON


def name_of(definition: object) -> str:
    """Return the name `module:name` under which a Warp function, a struct or a class is saved.

    For a file that runs as a program, the module is the file's stem, under which `--task-module` loads it.
    Raises TaskError unless the definition is at the top level of its module.
    """
    found, module, name = top_level(definition)
    if found is None:
        raise TaskError(f"{module}:{name} cannot be saved: define it under this name at the top level of a module")
    if module == "__main__":
        module = found.__spec__.name if found.__spec__ else Path(getattr(found, "__file__", module)).stem
    return f"{module}:{name}"


def json_value(value: object) -> Any:
    """Return a part of a task as JSON data: dicts with "type", lists, scalars. Raises TaskError: it cannot be saved."""
    if isinstance(value, Term):
        options = {key: json_value(option) for key, option in value.options.items()}
        named = {"type": name_of(type(value)), "func": name_of(value.func), "name": value.name}
        return {**named, **{key: json_value(number) for key, number in value.numbers.items()}, **options}
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        fields = {spec.name: json_value(getattr(value, spec.name)) for spec in dataclasses.fields(value)}
        return {"type": name_of(type(value)), **fields}
    if isinstance(value, wp.Function | Struct):
        return name_of(value)
    if isinstance(value, tuple):
        return [json_value(v) for v in value]
    if not (value is None or isinstance(value, bool | int | float | str)):
        raise TaskError(f"{shown(value)} cannot be saved: settings are numbers, strings, tuples and dataclasses")
    if isinstance(value, float) and not abs(value) <= FLOAT32_MAX:
        raise TaskError(f"settings must be finite, got {in_float32(value)}")
    return value


def task_to_json(task: TaskCfg) -> Json:
    """Return a task as JSON data: "version", and its fields by name. Raises TaskError: a part of it cannot be saved."""
    return {"version": VERSION, **json_value(task)}


def handover_to_json(handover: Handover) -> Json:
    """Return a handover between tasks as JSON data: names of tasks and functions. Raises TaskError: see `name_of`."""
    tasks = {"source": handover.source.name, "target": handover.target.name}
    return {**tasks, "when": name_of(handover.when), "begin": name_of(handover.begin)}


def shown(value: object) -> str:
    """Return a short description of any JSON value for messages: the scalar itself, or its type."""
    if value is None or isinstance(value, bool | int | float | str):
        return f"{value!r:.60}" if not isinstance(value, int) or abs(value) < 10**18 else "a huge integer"
    return f"a {type(value).__name__}"


# ---------------------------------------------------------------------- from JSON


@functools.cache
def project_modules() -> frozenset[str]:
    """Return the names of the project's modules whose functions and types a saved task may use."""
    packages = (jumper_warp.kernels, jumper_warp.robot, jumper_warp.tasks)
    walks = (pkgutil.walk_packages(package.__path__, f"{package.__name__}.") for package in packages)
    return frozenset(module.name for walk in walks for module in walk)


class Finder:
    """Look-up of functions and types that a saved task names (`module:name`), in modules of project and user."""

    def __init__(self, modules: Iterable[ModuleType] = ()) -> None:
        """Set the modules to search: the project's, `modules` (the user's loaded ones), and their neighbours."""
        self.modules = {module.__name__: module for module in with_neighbours(list(modules))}

    def __call__(self, name: object, where: str) -> Any:
        """Return the Warp function, struct, dataclass or subclass of `Term` called `name`; where: place for messages.

        Raises TaskError: there is none.
        """
        if not isinstance(name, str) or name.count(":") != 1:
            raise TaskError(f"{where}: expected module:name, got {shown(name)}")
        module_name, _, attribute = name.partition(":")
        module = self.modules.get(module_name)
        if module is None and module_name in project_modules():
            module = importlib.import_module(module_name)
        value = None if module is None else vars(module).get(attribute)
        usable = isinstance(value, wp.Function | Struct)
        if isinstance(value, type):
            usable = dataclasses.is_dataclass(value) or issubclass(value, Term)
        if not usable:
            known = module is not None or module_name.startswith("jumper_warp.")
            hint = "no such function or type" if known else "pass the file that defines it with --task-module"
            raise TaskError(f"{where} needs {name!r:.80}: {hint}")
        return value


def check_version(saved: object) -> None:
    """Raise TaskError unless `saved` is a task's JSON object in the current version of the format, VERSION."""
    if not isinstance(saved, dict):
        raise TaskError(f"the task must be a JSON object, got {shown(saved)}")
    if (version := saved.get("version")) != VERSION:
        raise TaskError(f"the task {version_error(shown(version), VERSION, LAST_OF_VERSION_4)}")


def task_from_json(saved: Any, modules: Iterable[ModuleType] = (), *, leave_out: Collection[str] = ()) -> TaskCfg:
    """Restore a task from the JSON data of `task_to_json`; missing settings have their defaults.

    modules: the user's loaded modules. leave_out: sections in OPTIONAL to make empty, whose functions may be missing.
    Raises TaskError: it is no task of this version, or a function is in none of the modules.
    """
    check_version(saved)
    content = {key: value for key, value in saved.items() if key not in ("version", "type")}
    content |= {section: [] for section in ("rewards", "events") if section in leave_out}
    if "critic" in leave_out and isinstance(observations := content.get("observations"), dict):
        content["observations"] = observations | {"critic": []}
    return _object(content, TaskCfg, "task", Finder(modules))


def _object(saved: Json, hint: Any, where: str, find: Finder) -> Any:
    """Return the term or dataclass that a JSON object describes; its "type" names a subclass of `hint`.

    The constructor checks the values. where: place for messages. Raises TaskError.
    """
    kind = find(saved["type"], where) if "type" in saved else hint
    content = {key: value for key, value in saved.items() if key != "type"}
    try:
        if issubclass(kind, Term):
            hints = {key: object if key in {"name", *kind.options} else float for key in content}
            hints |= {"func": wp.Function, "counts": wp.Function}
        else:
            hints = get_type_hints(kind)
        values = {key: _value(value, hints.get(key), f"{where}.{key}", find) for key, value in content.items()}
        return kind(**values)
    except TaskError:
        raise
    except (ArithmeticError, AttributeError, LookupError, NameError, TypeError, ValueError) as error:
        raise TaskError(f"{where}: {error!s:.200}") from error


def _value(saved: Any, hint: Any, where: str, find: Finder) -> Any:
    """Return a saved value as the field or argument of this type hint holds it; where: place for messages."""
    if get_origin(hint) in (Union, UnionType):
        hint = next(kind for kind in get_args(hint) if kind is not type(None))
    if isinstance(saved, dict):
        return _object(saved, hint, where, find)
    if isinstance(saved, list):
        kinds = get_args(hint) or (hint, Ellipsis)
        last = 0 if kinds[-1] is Ellipsis else len(kinds) - 1
        return tuple(_value(part, kinds[min(i, last)], f"{where}[{i}]", find) for i, part in enumerate(saved))
    if isinstance(saved, str) and hint in (wp.Function, Any):
        return find(saved, where)
    return float(saved) if hint is float and type(saved) is int else saved
