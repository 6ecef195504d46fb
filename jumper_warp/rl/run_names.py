"""Folders of training runs: their names and those of their seeds.

A run's folder is named by the local time of its start, with its offset from UTC, and perhaps by its `run_name`. A run
of several seeds has a folder `seed_N` for each, which is a run's folder too; `RUN:N` is short for it.
"""

from __future__ import annotations

from collections.abc import Iterable
from contextlib import suppress
from datetime import datetime
from pathlib import Path

LOCAL = "%Y-%m-%d_%H-%M-%S_%f"
ZONED = 31  # Number of characters of the time in a folder's name
CHECKPOINTS = "checkpoints"  # Folder in a run's folder that holds its checkpoints
MANIFEST = "manifest.json"  # File of checksums and scores in CHECKPOINTS
SEED = "seed_"  # Begin of the folder's name of a seed
FROZEN = "frozen.txt"  # File in the folder of a seed whose training ended early, with the reason


def run_name(microseconds: int, name: str | None = None) -> str:
    """Return the name of a run's folder: time of its start [µs] since 1970, as 2026-03-01_12-30-00_123456+0100, _name.

    Spaces in the name become hyphens.
    """
    started = datetime.fromtimestamp(microseconds // 1_000_000).astimezone()
    time = started.replace(microsecond=microseconds % 1_000_000).strftime(f"{LOCAL}%z")
    return f"{time}_{name.replace(' ', '-')}" if name else time


def start_time(folder: Path) -> float:
    """Return the time of a run's start [s] since 1970, from its folder's name; of a renamed run, of its last change."""
    for length, form in ((ZONED, f"{LOCAL}%z"), (26, LOCAL)):
        with suppress(ValueError):
            return datetime.strptime(folder.name[:length], form).timestamp()
    return folder.stat().st_mtime


def newest(folders: Iterable[Path]) -> Path | None:
    """Return the folder of the run that started last; None: there are no folders."""
    return max(folders, key=lambda folder: (start_time(folder), folder.name), default=None)


def title(folder: Path) -> str:
    """Return the name of a run for titles: its `run_name`, else its folder's name; `:N` follows for seed N."""
    folder = folder.resolve()
    if folder.name.startswith(SEED):
        return f"{title(folder.parent)}:{folder.name.removeprefix(SEED)}"
    with suppress(ValueError):
        datetime.strptime(folder.name[:ZONED], f"{LOCAL}%z")
        return folder.name[ZONED + 1 :] or folder.name
    return folder.name


def seed_folders(run: Path) -> dict[int, Path]:
    """Return the folders of a run's seeds by seed, in ascending order; empty: a run of one seed, or no run."""
    folders = {path.name.removeprefix(SEED): path for path in run.glob(f"{SEED}*/")}
    return {seed: folders[str(seed)] for seed in sorted(int(name) for name in folders if name.isdecimal())}


def split_seed(source: str | Path) -> tuple[Path, int | None]:
    """Split `RUN:N` into path and seed; None: there is no such suffix, or the whole is the path of a file."""
    text, _, seed = str(source).rpartition(":")
    if text and seed.isdecimal() and not Path(source).exists():
        return Path(text), int(seed)
    return Path(source), None
