"""Locks of folders that one process writes at a time; reading needs no lock."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from filelock import FileLock, Timeout

from jumper_warp.utils.errors import InputError

LOCK = "run.lock"  # Lock file in a run's folder; it stays after the run and may be copied or deleted with it


@contextmanager
def write_lock(folder: Path, file: Path | None = None) -> Iterator[None]:
    """Hold the lock of a folder while this process writes it; the operating system releases it if the process dies.

    file: lock file, removed afterwards (default: LOCK in the folder, which stays). Raises InputError: another process
    holds the lock. OSError: the file cannot be written.
    """
    lock = FileLock(file or folder / LOCK)
    try:
        lock.acquire(blocking=False)
    except Timeout as error:
        raise InputError(f"{folder}: another process is writing this folder; wait for its end, or stop it") from error
    try:
        yield
    finally:
        if file is not None:
            file.unlink(missing_ok=True)
        lock.release()
