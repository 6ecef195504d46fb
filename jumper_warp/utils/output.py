"""Output folders, and the figures (numbers) that an experiment reports."""

import json
import math
import os
import sys
from collections.abc import Mapping
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np

from jumper_warp.utils.errors import InputError
from jumper_warp.utils.runtime import device_info, git_commit, versions

Scalar = float | int | str | bool | None


def output_dir(name: str, out: Path | None = None) -> Path:
    """Create and return the folder for one run's results.

    Args:
        name: The experiment, one path component.
        out: Folder to use as it is, new or not. Default: `outputs/<name>/<YYYY-mm-dd_HH-MM-SS>` below the working
            folder, with a number appended if two runs start in the same second.

    Raises:
        ValueError: `name` is empty or holds a path separator.
        FileExistsError: `out` is a file.
    """
    if name in ("", "..") or Path(name).name != name:
        raise InputError(f"an experiment name is one path component, got {name!r}")
    if out is not None:
        out.mkdir(parents=True, exist_ok=True)
        return out
    stamp = datetime.now().strftime("%Y-%m-%d_%H-%M-%S")
    folder = Path("outputs", name, stamp)
    repeat = 1
    while folder.exists():
        repeat += 1
        folder = folder.with_name(f"{stamp}_{repeat}")
    folder.mkdir(parents=True)
    return folder


def write_metrics(folder: Path, figures: Mapping[str, Scalar | list[Scalar]]) -> Path:
    """Write `metrics.json`, and beside it `run.json` with what made them; return the path of `metrics.json`.

    Each file is complete or absent: it is written aside and moved into place. `run.json` holds `commit`, `dirty`,
    `versions`, `device` and `command`; nothing of the environment.

    Args:
        folder: An existing folder.
        figures: Flat. Give the unit in the name, as in `apex [m]`. NumPy scalars are taken as Python's.

    Raises:
        ValueError: A figure is infinite or not a number; the message names it.
        TypeError: A value is of another kind; the message names it.
    """
    plain = {key: _plain(key, value) for key, value in figures.items()}
    commit = git_commit()
    run = {
        "commit": commit.hash if commit else None,
        "dirty": commit.dirty if commit else None,
        "versions": versions(),
        "device": device_info()._asdict(),
        "command": [Path(sys.argv[0]).name, *sys.argv[1:]],
    }
    _write_json(folder / "run.json", run)
    return _write_json(folder / "metrics.json", plain)


def _plain(name: str, value: Any) -> Scalar | list[Scalar]:
    """Return a figure as plain Python, or raise an error that names it."""
    if not isinstance(name, str):
        raise TypeError(f"the name of a figure must be a string, got {name!r}")
    if isinstance(value, list):
        return [_plain_scalar(f"{name}[{index}]", item) for index, item in enumerate(value)]
    return _plain_scalar(name, value)


def _plain_scalar(name: str, value: Any) -> Scalar:
    if isinstance(value, np.generic):
        value = value.item()
    if not isinstance(value, Scalar):
        kind = type(value).__name__
        raise TypeError(f"figure {name!r} must be a number, string, bool, None or flat list, got {kind}")
    if isinstance(value, float) and not math.isfinite(value):
        raise InputError(f"figure {name!r} is {value}: only finite numbers are reported")
    return value


def _write_json(path: Path, content: Mapping[str, Any]) -> Path:
    """Write JSON to `path` through a temporary file in the same folder."""
    aside = path.with_name(f".{path.name}.{os.getpid()}")
    try:
        aside.write_text(json.dumps(content, indent=2, ensure_ascii=False, allow_nan=False) + "\n", encoding="utf-8")
        os.replace(aside, path)
    finally:
        aside.unlink(missing_ok=True)
    return path
