"""Errors of Warp about functions that do not compile, as one line with file, line and function."""

from __future__ import annotations

import linecache
import os
import re
import traceback
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from typing import Any

from jumper_warp.utils.errors import InputError, suggestion

PLACE = re.compile(r'Error while parsing function "(\w+)" at (.+):\d+:\n(.*)\n')
"""Function, file and source line in Warp's message about a kernel that does not compile; the last match counts."""
READ = re.compile(r"`(\w+)` is not an attribute of '[^']*'(?: \((?:.*\.)?(\w+)\))?")
WRITTEN_IN_PYTHON = re.compile(r"Trying to set Warp struct attribute that does not exist (\w+)")


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
def explained(types: Iterable[Any]) -> Iterator[None]:
    """Convert Warp's errors about functions that do not compile, raised in the block, to InputError with file and line.

    types: of the function's arguments; their structs have the fields that it may use. Other exceptions propagate.
    """
    try:
        yield
    except Exception as error:
        fields = {kind.key.rsplit(".", 1)[-1]: list(kind.vars) for kind in types if hasattr(kind, "vars")}
        if message := _message(error, fields):
            raise InputError(message) from None
        raise


def _message(error: Exception, structs: Mapping[str, list[str]]) -> str | None:
    """Describe in a line why Warp cannot compile a function; None: another error. structs: field names by struct."""
    found = codegen_error(error)
    owner = ""
    known = [name for fields in structs.values() for name in fields]
    if found is None:
        if not (match := WRITTEN_IN_PYTHON.fullmatch(str(error))):
            return None
        frame = traceback.extract_tb(error.__traceback__)[-2]  # the last one is Warp's
        place = f"{os.path.basename(frame.filename)}:{frame.lineno}, function {frame.name}"
        field = match[1]
    else:
        place, cause = found
        if match := READ.search(cause):
            field = match[1]
            owner = match[2] or ""
            known = structs.get(owner, [])
        elif isinstance(error, KeyError):  # an assignment
            field = cause
        else:
            return f"{place}: {cause}"
    hint = suggestion(field, known) or (f"; it has {', '.join(known)}" if owner and known else "")
    return f"{place}: {f'{owner} has no' if owner else 'unknown'} field {field!r}{hint:.300}"
