"""Output folders, and the figures (numbers) that an experiment reports."""

import math
import sys
from collections.abc import Mapping
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np

from jumper_warp.utils.errors import InputError
from jumper_warp.utils.files import json_bytes, write_atomically
from jumper_warp.utils.runtime import device_info, source_versions

Scalar = float | int | str | bool | None


def output_dir(name: str, out: Path | None = None) -> Path:
    """Create and return the folder for one run's results.

    name: the experiment, one path component. out: the folder, new or not; by default
    `outputs/<name>/<YYYY-mm-dd_HH-MM-SS>` below the working folder, with a number appended if two runs start in the
    same second. Raises ValueError: `name` is empty or holds a path separator. FileExistsError: `out` is a file.
    """
    if name in ("", "..") or Path(name).name != name:
        raise InputError(f"an experiment name is one path component, got {name!r}")
    if out is not None:
        out.mkdir(parents=True, exist_ok=True)
        return out
    stamp = datetime.now().strftime("%Y-%m-%d_%H-%M-%S")
    folder, repeat = Path("outputs", name, stamp), 1
    while folder.exists():
        repeat += 1
        folder = folder.with_name(f"{stamp}_{repeat}")
    folder.mkdir(parents=True)
    return folder


def write_metrics(folder: Path, figures: Mapping[str, Scalar | list[Scalar]]) -> Path:
    """Write `metrics.json`, and beside it `run.json` with what made them; return the path of `metrics.json`.

    Each file is complete or absent: it is written aside and moved into place. `run.json` holds `commit`, `dirty`,
    `versions`, `device` and `command`; nothing of the environment.

    folder: an existing one. figures: flat, with the unit in the name, as in `apex [m]`; NumPy scalars are taken as
    Python's. Raises ValueError: a figure is infinite or NaN. TypeError: a value is of another kind. Both name it.
    """
    plain = {key: _plain(key, value) for key, value in figures.items()}
    command = [Path(sys.argv[0]).name, *sys.argv[1:]]
    run = source_versions() | {"device": device_info()._asdict(), "command": command}
    for name, content in (("run.json", run), ("metrics.json", plain)):
        write_atomically(folder / name, json_bytes(content))
    return folder / "metrics.json"


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
        raise TypeError(f"figure {name!r} must be a number, string or None, or a flat list, got {type(value).__name__}")
    if isinstance(value, float) and not math.isfinite(value):
        raise InputError(f"figure {name!r} is {value}: only finite numbers are reported")
    return value
