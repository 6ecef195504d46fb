"""Checks of a task's Warp functions and structs, before a kernel is compiled.

Warp's own errors name generated code; these name the user's file and line. "Own" means a user's, from outside the
project, whose functions need no check.
"""

from __future__ import annotations

import ast
import functools
import inspect
import linecache
import os
import re
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import warp as wp

from jumper_warp.tasks.copying import Struct
from jumper_warp.utils.errors import InputError
from jumper_warp.utils.kernels import content_hash
from jumper_warp.utils.sources import PROJECT_PREFIX
from jumper_warp.utils.threads import locked

PLACE = re.compile(r'Error while parsing function "(\w+)" at (.+):\d+:\n(.*)\n')
"""Function, file and source line in Warp's message about a kernel that does not compile; the last match counts."""
SAME = {float: wp.float32, int: wp.int32, bool: wp.bool}  # Warp's types by Python's


def source_of(definition: Any) -> Any:
    """Return the Python function or class that defines a Warp function or struct, or the class of any other object."""
    if isinstance(definition, wp.Function):
        return definition.func
    return definition.cls if isinstance(definition, Struct) else type(definition)


def place_of(definition: object) -> str:
    """Return file and line where a Warp function, a struct or an object's class is defined, as `my_task.py:12`."""
    source = source_of(definition)
    try:
        return f"{Path(inspect.getsourcefile(source) or '').name}:{inspect.getsourcelines(source)[1]}"
    except (OSError, TypeError):  # without a file, as in a terminal
        return source.__module__ or ""


def is_own(definition: object) -> bool:
    """Return whether a user defined a Warp function, a struct or an object's class, outside this project."""
    return not (source_of(definition).__module__ or "").startswith(PROJECT_PREFIX)  # None: made by exec


def shown_type(kind: Any) -> str:
    """Return the name of a type for messages, such as `int32`, `vec3f` or `nothing`."""
    if kind in (None, type(None)):
        return "nothing"
    scalar = getattr(kind, "_wp_scalar_type_", None)
    if scalar and hasattr(kind, "_length_"):
        return f"a vector of {kind._length_}"
    return getattr(kind, "__name__", None) or getattr(kind, "key", str(kind)).rsplit(".", 1)[-1]


def check_function(
    where: str, func: Any, takes: Sequence[object], returns: str, may_return: Callable[[object], bool]
) -> None:
    """Raise InputError, with file and line, unless a Warp function has argument types `takes` and a valid return type.

    Body and return type are checked only of functions from outside the project. where: part of the task, for messages.
    returns: type of the result in words; may_return: whether a type is valid.
    """
    name = func.key.rsplit(".", 1)[-1]
    actual = list(func.input_types.values())
    if len(actual) != len(takes):
        wanted = f"must have {len(takes)} arguments ({', '.join(map(shown_type, takes))})"
        raise InputError(f"{place_of(func)}: {where}: the function {wanted}, it has {len(actual)}")
    for i, (kind, wanted) in enumerate(zip(actual, takes, strict=True), 1):
        if isinstance(kind, Struct) or SAME.get(kind, kind) in SAME.values():
            if SAME.get(kind, kind) is not SAME.get(wanted, wanted):
                found = f"is {shown_type(kind)}, the task has {shown_type(wanted)}"
                raise InputError(f"{place_of(func)}: {where}: argument {i} of {name} {found}")
    if not is_own(func):
        return
    with explained():
        returned = _returned(func, tuple(takes), content_hash(func))
    if not may_return(returned):
        found = f"the function must return {returns}, it returns {shown_type(returned)}"
        raise InputError(f"{place_of(func)}: {where}: {found}")
    for each in _with_called(func):
        if _may_end_without_result(each):
            name = each.key.rsplit(".", 1)[-1]
            raise InputError(f"{place_of(each)}: {where}: {name} ends without `return` in some cases, add one")


def codegen_error(error: Exception) -> tuple[str, str] | None:
    """Return where and why Warp cannot compile a function (`file.py:12, function name`, cause); None: another error."""
    text = str(error.args[0]) if error.args else ""  # str(KeyError) would escape line breaks
    if not (places := PLACE.findall(text)):
        return None
    name, path, source = places[-1]
    # Warp's number of the line counts from the function's start if an argument is of type Any
    rows = [row.strip() for row in linecache.getlines(path)]
    start = next((i for i, row in enumerate(rows) if row.startswith(f"def {name}(")), 0)
    line = next((i for i, row in enumerate(rows[start:], start + 1) if row == source.strip()), start + 1)
    cause = text.rsplit(";", 1)[-1].strip(" ,").removeprefix("Error, ")
    return f"{os.path.basename(path)}:{line}, function {name}", cause


@contextmanager
def explained() -> Iterator[None]:
    """Convert Warp's errors about functions that do not compile, raised in the block, to InputError with file and line.

    Other exceptions propagate.
    """
    try:
        yield
    except Exception as error:
        if (found := codegen_error(error)) is None:
            raise
        place, cause = found
        unknown = "unknown field " if isinstance(error, KeyError) else ""  # an assignment
        raise InputError(f"{place}: {unknown}{cause}") from None


def _with_called(func: wp.Function) -> set[wp.Function]:
    """Return a Warp function and all functions from outside the project that it calls, directly or not."""
    found = set()
    rest = [func]
    while rest:
        each = rest.pop()
        if each not in found and not each.is_builtin() and is_own(each):
            found.add(each)
            rest += each.adj.get_references()[2]
    return found


def _may_end_without_result(func: Any) -> bool:
    """Return whether a Warp function returns a value on some paths but not on all; on the others Warp returns zeros."""

    def returns(statements: list[ast.stmt]) -> bool:
        """Return whether every path through the statements reaches a `return`."""
        return any(
            isinstance(each, ast.Return) or (isinstance(each, ast.If) and returns(each.body) and returns(each.orelse))
            for each in statements
        )

    tree = func.adj.tree
    has_value = any(isinstance(node, ast.Return) and node.value is not None for node in ast.walk(tree))
    return has_value and not returns(tree.body[0].body)


def check_result(where: str, func: Any, takes: Sequence[object], returns: object) -> None:
    """Raise InputError, with file and line, unless a function has argument types `takes` and return type `returns`."""
    where = f"{where} {func.key.rsplit('.', 1)[-1]}"
    check_function(where, func, takes, shown_type(returns), lambda kind: SAME.get(kind, kind) is returns)


@functools.cache
@locked
def _returned(func: wp.Function, takes: tuple[Any, ...], content: bytes) -> Any:
    """Return the type that a Warp function returns for arguments of types `takes`, None without a `return`.

    content: its `content_hash`, for the cache.
    """
    overload: Any = func.get_overload(list(takes), {})
    if overload is None:
        raise InputError(f"{place_of(func)}: {func.key} must take ({', '.join(map(shown_type, takes))})")
    overload.build(None, overload.module.options)
    if overload.native_snippet is None and not overload.adj.return_var:
        return None
    return overload.value_func(None, None)


def check_values(where: str, settings: object, *args: float) -> None:
    """Raise InputError unless `settings.struct` is a Warp struct, and `settings.values(*args)` returns an instance.

    The instance is checked only of settings from outside the project.
    """
    struct = getattr(settings, "struct", None)
    values = getattr(settings, "values", None)
    if not isinstance(struct, Struct) or not callable(values):
        raise InputError(f"{where}: {type(settings).__name__} must have the attributes struct and values()")
    if is_own(settings):
        made = values(*args)
        if getattr(made, "_cls", None) is not struct:
            found = f"must return {shown_type(struct)}, it returns {type(made).__name__}"
            raise InputError(f"{place_of(settings)}: {where}: values of {type(settings).__name__} {found}")
