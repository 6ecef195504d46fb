"""Atomic file writes, and the check that a file exists."""

import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from jumper_warp.utils.errors import InputError


def write_atomically(path: Path, data: bytes) -> None:
    """Write a file atomically: readers see either the old or the new content, also after a power failure.

    Raises OSError: the disk is full or the folder cannot be written; its `filename` is the path.
    """
    part = path.with_name(path.name + ".part")
    try:
        with part.open("wb") as file:
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
        os.replace(part, path)
    except OSError as error:
        error.filename = str(path)
        raise
    finally:
        part.unlink(missing_ok=True)
    folder = os.open(path.parent, os.O_RDONLY)
    try:
        os.fsync(folder)
    finally:
        os.close(folder)


def json_bytes(content: Mapping[str, Any]) -> bytes:
    """Convert an object to the bytes of a JSON file. Raises ValueError: a number is not finite."""
    return (json.dumps(content, indent=2, ensure_ascii=False, allow_nan=False) + "\n").encode()


def existing_file(path: Path, purpose: str) -> Path:
    """Check that a file exists, and return its path.

    Raises InputError, with the purpose of the file: it does not exist.
    """
    if not Path(path).is_file():
        kind = "a folder, not a file" if Path(path).is_dir() else "no such file"
        raise InputError(f"{path}: {kind} ({purpose})")
    return Path(path)
