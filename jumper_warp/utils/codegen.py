"""Errors of Warp about functions that do not compile, as one line with file, line and function."""

from __future__ import annotations

import linecache
import os
import re
from collections.abc import Iterator
from contextlib import contextmanager

from jumper_warp.utils.errors import InputError

PLACE = re.compile(r'Error while parsing function "(\w+)" at (.+):\d+:\n(.*)\n')
"""Function, file and source line in Warp's message about a kernel that does not compile; the last match counts."""


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
