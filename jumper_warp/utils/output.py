"""Output folders and metrics files of experiments."""

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

Scalar = float | int | str | bool | None  # type of a metric


def output_dir(name: str, out: Path | None = None) -> Path:
    """Create and return the folder for one run's results.

    name: of the experiment, one path component. out: the folder, which may exist (default:
    `outputs/<name>/<YYYY-mm-dd_HH-MM-SS>`, with a number appended if two runs start in the same second).
    Raises InputError: `name` is empty or has a path separator. FileExistsError: `out` is a file.
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


def write_metrics(folder: Path, metrics: Mapping[str, Scalar | list[Scalar]]) -> Path:
    """Write `metrics.json` and `run.json` (commit, dirty, versions, device, command); return the path of metrics.json.

    Each file is written atomically. Environment variables are not saved.
    folder: an existing folder. metrics: flat, with the unit in the name, as in `apex [m]`; NumPy scalars become Python
    numbers. Raises InputError: a metric is not finite. TypeError: a value has another type. Both name the metric.
    """
    python_metrics = {key: _to_python(key, value) for key, value in metrics.items()}
    command = [Path(sys.argv[0]).name, *sys.argv[1:]]
    run = source_versions() | {"device": device_info()._asdict(), "command": command}
    for name, content in (("run.json", run), ("metrics.json", python_metrics)):
        write_atomically(folder / name, json_bytes(content))
    return folder / "metrics.json"


def _to_python(name: str, value: Any) -> Scalar | list[Scalar]:
    """Return a metric as a Python scalar or list of scalars. Raises TypeError or InputError as `write_metrics`."""
    if not isinstance(name, str):
        raise TypeError(f"the name of a metric must be a string, got {name!r}")
    if isinstance(value, list):
        return [_to_python_scalar(f"{name}[{index}]", item) for index, item in enumerate(value)]
    return _to_python_scalar(name, value)


def _to_python_scalar(name: str, value: Any) -> Scalar:
    """Return a scalar as a Python object. Raises TypeError or InputError: another type, or not finite."""
    if isinstance(value, np.generic):
        value = value.item()
    if not isinstance(value, Scalar):
        raise TypeError(f"metric {name!r} must be a number, string or None, or a flat list, got {type(value).__name__}")
    if isinstance(value, float) and not math.isfinite(value):
        raise InputError(f"metric {name!r} is {value}: only finite numbers are reported")
    return value
