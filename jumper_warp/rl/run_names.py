"""Folders of training runs: their names, those of their seeds, and what `jumper list runs` shows of them.

A run's folder is named by the local time of its start, with its offset from UTC, and perhaps by its `run_name`. A run
of several seeds has a folder `seed_N` for each, which is a run's folder too; `RUN:N` is short for it.
"""

from __future__ import annotations

import json
import statistics
from collections.abc import Iterable
from contextlib import suppress
from datetime import datetime
from pathlib import Path

from jumper_warp.utils.errors import InputError
from jumper_warp.utils.files import read_json

LOCAL = "%Y-%m-%d_%H-%M-%S_%f"
ZONED = 31  # Number of characters of the time in a folder's name
CHECKPOINTS = "checkpoints"  # Folder in a run's folder that holds its checkpoints
MANIFEST = "manifest.json"  # File of checksums and scores in CHECKPOINTS
SEED = "seed_"  # Begin of the folder's name of a seed


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
    return folder.name[ZONED + 1 :] or folder.name


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


def seed_of(run: Path, seed: int | None) -> Path:
    """Return the folder of a seed of a run, by default of the median seed by the score of its best checkpoint.

    A run of one seed has no such folders: without a seed, return the run. Raises InputError: there is no such seed.
    """
    folders = {name: path for name, path in seed_folders(run).items() if any((path / CHECKPOINTS).glob("*.pt"))}
    if seed is None:
        scores = {path: score for path in folders.values() if (score := best_score(path)) is not None}
        middle = statistics.median_low(scores.values()) if scores else None
        return next((path for path, score in scores.items() if score == middle), next(iter(folders.values()), run))
    if seed not in folders:
        known = ", ".join(map(str, folders)) or "none"
        raise InputError(f"{run}: no checkpoint of seed {seed}; seeds with checkpoints: {known}")
    return folders[seed]


def best_score(run: Path) -> float | None:
    """Return the score of the best checkpoint in a run's folder; None: none has a score."""
    entries = read_json(run / CHECKPOINTS / MANIFEST, "checksums of checkpoints", finite=False).values()
    scores = [entry["score"] for entry in entries if entry.get("score") is not None]
    return max(scores, default=None)


def last_metrics(run: Path, file: str) -> dict[str, float | None]:
    """Return the metrics of the last line that a training logged in `file`; empty: there is none."""
    with suppress(OSError, ValueError, IndexError):
        line = json.loads((run / file).read_bytes().splitlines()[-1])
        return line if isinstance(line, dict) else {}
    return {}
