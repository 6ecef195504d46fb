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
from jumper_warp.tasks.ranges import Pair
from jumper_warp.tasks.terms import RewardTerm, Term
from jumper_warp.utils.checks import FLOAT32_MAX, NAME, in_float32, version_error
from jumper_warp.utils.errors import InputError
from jumper_warp.utils.sources import with_neighbours

VERSION, LAST_OF_VERSION_4 = 5, "7f5b55c3"  # Version of the saved format; last commit that reads version 4
OPTIONAL = ("rewards", "critic", "events")  # sections that only training needs
MAX_ENTRIES = 1000  # of a list: a kernel of more terms would compile for a day


class TaskError(InputError):
    """Error: a saved task cannot be restored, or a task cannot be saved. The message is one line."""


# ---------------------------------------------------------------------- to JSON


def name_of(definition: Any) -> str:
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


def json_value(value: Any) -> Any:
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


def task_to_json(task: TaskCfg) -> dict[str, Any]:
    """Return a task as JSON data: "version", and its fields by name. Raises TaskError: a part of it cannot be saved."""
    return {"version": VERSION, **json_value(task)}


def handover_to_json(handover: Handover) -> dict[str, Any]:
    """Return a handover between tasks as JSON data: names of tasks and functions. Raises TaskError: see `name_of`."""
    tasks = {"source": handover.source.name, "target": handover.target.name}
    return {**tasks, "when": name_of(handover.when), "begin": name_of(handover.begin)}


def shown(value: Any) -> str:
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

    def __call__(self, name: Any, where: str) -> Any:
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


def check_version(saved: Any) -> None:
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
    try:
        return _build(TaskCfg, content, "task", Finder(modules))
    except TaskError:
        raise
    except (ValueError, TypeError, KeyError, AttributeError, ArithmeticError, NameError) as error:
        raise TaskError(f"task: {error!s:.200}") from error


def _build(kind: type, saved: dict[str, Any], where: str, find: Finder) -> Any:
    """Return a dataclass of type `kind` from its saved fields; missing fields have their defaults. Raises TaskError."""
    hints = get_type_hints(kind)
    fields = {spec.name: spec for spec in dataclasses.fields(kind) if spec.init}
    unknown = [name for name in saved if name not in fields]
    if unknown:
        raise TaskError(f"{where}: unknown setting {unknown[0]!r:.60}")
    for name, spec in fields.items():
        if name not in saved and spec.default is spec.default_factory is dataclasses.MISSING:
            raise TaskError(f"{where}.{name} is missing")
    values = {name: _value(value, hints[name], f"{where}.{name}", find) for name, value in saved.items()}
    try:
        return kind(**values)
    except ValueError as error:
        raise TaskError(f"{where}: {error!s:.200}") from error


def _value(saved: Any, hint: Any, where: str, find: Finder) -> Any:
    """Return a saved value converted to the type hint of its field; where: place for messages. Raises TaskError."""
    if get_origin(hint) in (Union, UnionType):
        kinds = get_args(hint)
        if saved is None and type(None) in kinds:
            return None
        hint = next(kind for kind in kinds if kind is not type(None))
    if isinstance(saved, dict):
        return _object(saved, hint, where, find)
    if hint is wp.Function or (hint is Any and isinstance(saved, str)):
        value = find(saved, where)
        if hint is wp.Function and not isinstance(value, wp.Function):
            raise TaskError(f"{where}: {saved!r:.80} is not a @wp.func")
        return value
    if get_origin(hint) is tuple or isinstance(saved, list):
        return _tuple(saved, hint, where, find)
    return _scalar(saved, hint, where)


def _tuple(saved: Any, hint: Any, where: str, find: Finder) -> tuple[Any, ...]:
    """Return a saved list as a tuple of the hinted length and element types. Raises TaskError."""
    kinds = get_args(hint)
    if get_origin(hint) is not tuple or not isinstance(saved, list):
        raise TaskError(f"{where}: expected {_word(hint)}, got {shown(saved)}")
    if len(saved) > MAX_ENTRIES:
        raise TaskError(f"{where}: expected at most {MAX_ENTRIES} entries, got {len(saved)}")
    if len(kinds) == 2 and kinds[1] is Ellipsis:
        kinds = (kinds[0],) * len(saved)
    if len(kinds) != len(saved):
        raise TaskError(f"{where}: expected {len(kinds)} entries, got {len(saved)}")
    return tuple(_value(v, k, f"{where}[{i}]", find) for i, (v, k) in enumerate(zip(saved, kinds, strict=True)))


def _object(saved: dict[str, Any], hint: Any, where: str, find: Finder) -> Any:
    """Return the term or dataclass that a JSON object describes; its "type" (default: the hint) names a subclass."""
    base = object if hint is Any else hint
    kind = hint if "type" not in saved and dataclasses.is_dataclass(hint) else find(saved.get("type"), where)
    if not (isinstance(kind, type) and isinstance(base, type) and issubclass(kind, base)):
        raise TaskError(f"{where}: expected {_word(hint)}, got {shown(saved.get('type'))}")
    content = {key: value for key, value in saved.items() if key != "type"}
    return _term(kind, content, where, find) if issubclass(kind, Term) else _build(kind, content, where, find)


def _term(kind: type[Term], saved: dict[str, Any], where: str, find: Finder) -> Term:
    """Return a term of class `kind` from its saved function, numbers and options. Raises TaskError."""
    func = _value(saved.pop("func", None), wp.Function, where, find)
    name = saved.get("name")
    if "name" in saved and (not isinstance(name, str) or not NAME.fullmatch(name)):
        raise TaskError(f"{where}: a name may contain letters, digits, _ . - and spaces, got {shown(name)}")
    for key, default in kind.options.items():
        if key not in saved:
            continue
        hint = type(default) if isinstance(default, bool | int | str) else wp.Function
        hint = tuple[int, ...] | None if default is None else hint
        saved[key] = _value(saved[key], hint, f"{where}.{key}", find)
    if not 0 <= saved.get("history", 1) <= MAX_ENTRIES:
        raise TaskError(f"{where}.history must be at most {MAX_ENTRIES}")
    for key in set(saved) - set(kind.options) - {"name"}:
        hint = Pair if isinstance(kind.settings.get(key), tuple) else float
        saved[key] = _value(saved[key], hint, f"{where}.{key}"[:100], find)
    if kind is RewardTerm and "weight" not in saved:
        raise TaskError(f"{where}: a reward needs a weight")
    try:
        return kind(func, **saved)
    except ValueError as error:
        raise TaskError(f"{where}: {error!s:.200}") from error


def _scalar(saved: Any, hint: Any, where: str) -> Any:
    """Return a saved number, string or bool that fits a type hint. Raises TaskError.

    The hint is float, int, str, bool, a Literal or Any.
    """
    kinds = {float: (float, int), int: (int,), str: (str,), bool: (bool,)}.get(hint)
    if get_args(hint) and not kinds:  # a Literal
        if saved not in get_args(hint):
            raise TaskError(f"{where}: must be one of {get_args(hint)}, got {shown(saved)}")
        return saved
    number = isinstance(saved, int | float) and not isinstance(saved, bool)
    if number and not abs(saved) <= FLOAT32_MAX:
        raise TaskError(f"{where}: must be finite, got {shown(saved)}")
    if kinds is None:
        if hint is Any and (saved is None or isinstance(saved, bool | int | float | str)):
            return saved
        raise TaskError(f"{where}: expected {_word(hint)}, got {shown(saved)}")
    if isinstance(saved, bool) != (hint is bool) or not isinstance(saved, kinds):
        raise TaskError(f"{where}: expected {_word(hint)}, got {shown(saved)}")
    return hint(saved)


def _word(hint: Any) -> str:
    """Return a type hint in words, for messages."""
    if get_origin(hint) is tuple:
        return "a list"
    if isinstance(hint, type) and (dataclasses.is_dataclass(hint) or issubclass(hint, Term)):
        return f"settings by name, a {hint.__name__}"
    return getattr(hint, "__name__", str(hint))
