"""Errors of Warp about functions that do not compile, as one line with file, line and function."""

from __future__ import annotations

import linecache
import os
import re
import traceback
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager

from jumper_warp.utils.errors import InputError, suggestion

PLACE = re.compile(r'Error while parsing function "(\w+)" at (.+):\d+:\n(.*)\n')
"""Function, file and source line in Warp's message about a kernel that does not compile; the last match counts."""
READ = re.compile(r"`(\w+)` is not an attribute of '[^']*'(?: \((?:.*\.)?(\w+)\))?")
WRITTEN_IN_PYTHON = re.compile(r"Trying to set Warp struct attribute that does not exist (\w+)")


def codegen_error(error: Exception) -> tuple[str, str, str] | None:
    """Return file, place (`file.py:12, function name`) and cause of an error in a Warp function; None: another."""
    text = str(error.args[0]) if error.args else ""  # str(KeyError) would escape line breaks
    if not (places := PLACE.findall(text)):
        return None
    name, path, source = places[-1]
    # Warp's number of the line counts from the function's start if an argument is of type Any
    rows = [row.strip() for row in linecache.getlines(path)]
    start = next((i for i, row in enumerate(rows) if row.startswith(f"def {name}(")), 0)
    line = next((i for i, row in enumerate(rows[start:], start + 1) if row == source.strip()), start + 1)
    return path, f"{os.path.basename(path)}:{line}, function {name}", text.rsplit(";", 1)[-1].strip(" ,")


@contextmanager
def explained_fields(structs: Mapping[str, Iterable[str]]) -> Iterator[None]:
    """Raise InputError, with file, line and similar names, where the block uses a field that a struct does not have.

    structs: names of the fields by name of the struct. Other exceptions propagate.
    """
    try:
        yield
    except Exception as error:
        if message := _field_message(error, structs):
            raise InputError(message) from None
        raise


def _field_message(error: Exception, structs: Mapping[str, Iterable[str]]) -> str | None:
    """Return one line about a field that a struct does not have; None: another error. structs: as above."""
    found, owner, known = codegen_error(error), "", [name for fields in structs.values() for name in fields]
    if found is None:
        if not (match := WRITTEN_IN_PYTHON.fullmatch(str(error))):
            return None
        frame = traceback.extract_tb(error.__traceback__)[-2]  # the last one is Warp's
        place, field = f"{os.path.basename(frame.filename)}:{frame.lineno}, function {frame.name}", match[1]
    else:
        _, place, cause = found
        if match := READ.search(cause):
            field, owner = match[1], match[2] or ""
            known = list(structs.get(owner, ()))
        elif isinstance(error, KeyError):  # an assignment
            field = cause
        else:
            return None
    hint = suggestion(field, known) or (f"; it has {', '.join(known)}" if owner and known else "")
    return f"{place}: {f'{owner} has no' if owner else 'unknown'} field {field!r}{hint:.300}"
