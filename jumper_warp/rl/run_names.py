"""Names of the folders of training runs: local time of the start, with its offset from UTC."""

from __future__ import annotations

from collections.abc import Iterable
from contextlib import suppress
from datetime import datetime
from pathlib import Path

LOCAL = "%Y-%m-%d_%H-%M-%S_%f"


def run_name(microseconds: int) -> str:
    """Return the name of a run by the time of its start [µs] since 1970, such as 2026-03-01_12-30-00_123456+0100."""
    started = datetime.fromtimestamp(microseconds // 1_000_000).astimezone()
    return started.replace(microsecond=microseconds % 1_000_000).strftime(f"{LOCAL}%z")


def start_time(folder: Path) -> float:
    """Return the time of a run's start [s] since 1970, from its folder's name; of a renamed run, of its last change."""
    for length, form in ((31, f"{LOCAL}%z"), (26, LOCAL)):
        with suppress(ValueError):
            return datetime.strptime(folder.name[:length], form).timestamp()
    return folder.stat().st_mtime


def newest(folders: Iterable[Path]) -> Path | None:
    """Return the folder of the run that started last; None: there are no folders."""
    return max(folders, key=lambda folder: (start_time(folder), folder.name), default=None)
