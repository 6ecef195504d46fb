"""Atomic file writes, and bounded reading of regular files and of JSON."""

import errno
import json
import math
import os
import stat
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from jumper_warp.utils.errors import InputError

Json = dict[str, Any]  # Object of JSON data, settings or values by name
ErrorType = Callable[[str], InputError]
MAX_BYTES = 256 * 2**20  # Size of the largest file that is read
MAX_JSON_BYTES = 16 * 2**20  # Size of the largest JSON file that is read


@contextmanager
def directory_lock(folder: Path) -> Iterator[int]:
    """Hold the lock of a directory while files in it are replaced; waits until other processes and threads release it.

    Without it two writers of one file would share its temporary file.
    Yields the directory's descriptor. No file is written. There is no lock on network file systems that do not support
    one. OSError: no such folder.
    """
    import fcntl  # absent on Windows, where files can still be read

    directory = os.open(folder, os.O_RDONLY)
    try:
        with suppress(OSError):
            fcntl.flock(directory, fcntl.LOCK_EX)
        yield directory
    finally:
        os.close(directory)


def write_atomically(path: Path, data: bytes) -> None:
    """Write a file atomically: readers see either the old or the new content, also after a power failure.

    Raises OSError: the disk is full, the folder cannot be written, or the path is a device or a folder; its `filename`
    is the path.
    """
    path = Path(path)
    if path.exists() and not path.is_file():
        raise OSError(errno.EINVAL, "not a regular file", str(path))
    part = path.with_name(path.name + ".part")
    try:
        with directory_lock(path.parent) as directory:
            try:
                with part.open("wb") as file:
                    file.write(data)
                    file.flush()
                    os.fsync(file.fileno())
                os.replace(part, path)
            except BaseException:
                part.unlink(missing_ok=True)
                raise
            os.fsync(directory)
    except OSError as error:
        error.filename = str(path)
        raise


def json_bytes(content: Mapping[str, Any]) -> bytes:
    """Convert an object to the bytes of a JSON file. Raises ValueError: a number is not finite."""
    return (json.dumps(content, indent=2, ensure_ascii=False, allow_nan=False) + "\n").encode()


def existing_file(path: Path, purpose: str, limit: int = MAX_BYTES, error: ErrorType = InputError) -> Path:
    """Check that a path is a regular file of at most `limit` bytes, and return it; the file is not opened.

    purpose: content of the file, for messages. error: class of the error. Raises `error` for anything else, such as a
    folder, a pipe or a device; the message has the path.
    """
    try:
        status = os.stat(path)
    except FileNotFoundError:
        raise error(f"{path}: no such file ({purpose})") from None
    except (OSError, ValueError) as problem:  # ValueError: a null character
        raise error(f"{path!s:.200}: cannot be read: {problem} ({purpose})") from None
    if not stat.S_ISREG(status.st_mode):
        kind = "a folder, not a file" if stat.S_ISDIR(status.st_mode) else "not a regular file"
        raise error(f"{path}: {kind} ({purpose})")
    if status.st_size > limit:
        raise error(f"{path}: larger than {limit >> 20} MiB ({purpose})")
    return Path(path)


def read_file(path: Path, purpose: str, limit: int = MAX_BYTES, error: ErrorType = InputError) -> bytes:
    """Return the bytes of a regular file; arguments and errors are those of `existing_file`."""
    try:
        with existing_file(path, purpose, limit, error).open("rb") as file:
            data = file.read(limit + 1)  # not more: another process may append to the file
    except OSError as problem:  # such as a file of the kernel that has no content
        raise error(f"{path}: cannot be read: {problem} ({purpose})") from None
    if len(data) > limit:
        raise error(f"{path}: larger than {limit >> 20} MiB ({purpose})")
    return data


def read_json(
    path: Path, purpose: str, limit: int = MAX_JSON_BYTES, error: ErrorType = InputError, finite: bool = True
) -> Any:
    """Read a JSON file and return its content; arguments and errors: see `existing_file` and `parse_json`."""
    return parse_json(read_file(path, purpose, limit, error), str(path), error, finite)


def parse_json(data: bytes | str, where: str, error: ErrorType = InputError, finite: bool = True) -> Any:
    """Parse JSON data (UTF-8) and return its content.

    where: file or place, before the message. finite: whether to refuse NaN and infinite numbers. Raises `error`: it is
    not JSON, or has such a number.
    """
    hooks: Json = {"parse_constant": _number, "parse_float": _number} if finite else {}
    try:
        text = data.decode() if isinstance(data, bytes) else data
        return json.loads(text, **hooks)
    except json.JSONDecodeError as problem:
        reason = f"line {problem.lineno}: {problem.msg}"
    except (ValueError, RecursionError) as problem:
        reason = str(problem)
    raise error(f"{where}: not JSON ({reason:.200})")


def _number(text: str) -> float:
    """Convert the text of a number in JSON to a float. Raises InputError: it is not finite."""
    value = float(text)
    if not math.isfinite(value):
        raise InputError(f"{text:.20} is not a finite number")
    return value
