"""Creation of output folders; writing and reading of `metrics.json` (layout: docs/metrics.schema.json)."""

import json
import math
import sys
from collections.abc import Mapping
from datetime import datetime
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from jumper_warp.utils.errors import InputError
from jumper_warp.utils.files import json_bytes, write_atomically
from jumper_warp.utils.metrics import AnyMetrics, MetricValue, Scalar, unit_of
from jumper_warp.utils.runtime import device_info, source_versions

VERSION = 1  # Version of the layout of metrics.json


class Report(NamedTuple):
    """Metrics of a run with the conditions in which they were measured, and the file that holds both."""

    path: Path  # of metrics.json
    conditions: dict[str, Any]  # conditions of the evaluation by name
    metrics: dict[str, MetricValue]  # values are Python numbers, strings, None, or lists of these

    @property
    def values(self) -> dict[str, Any]:
        """Conditions, and values of the metrics without intervals, by name."""
        return self.conditions | {key: metric.value for key, metric in self.metrics.items()}

    def to_json(self) -> dict[str, Any]:
        """Return the content of metrics.json."""
        entries = {
            key: {"value": metric.value, "unit": unit_of(key)} | metric._asdict()
            for key, metric in self.metrics.items()
        }
        header = {"schema": "jumper-warp metrics", "version": VERSION, "conditions": self.conditions}
        return header | {"metrics": entries}


def output_dir(name: str, out: Path | None = None) -> Path:
    """Create the folder for the results of one run, and return it.

    name: name of the experiment, one path component. out: the folder, which may exist (default:
    `outputs/<name>/<YYYY-mm-dd_HH-MM-SS>`, with a number appended if two runs start in the same second).
    Raises InputError: `name` is empty or has a path separator. FileExistsError: `out` is a file.
    """
    if name in ("", "..") or Path(name).name != name:
        raise InputError(f"an experiment name is one path component, got {name!r}")
    if out is not None:
        out.mkdir(parents=True, exist_ok=True)
        return out
    stamp = datetime.now().strftime("%Y-%m-%d_%H-%M-%S")
    folder = Path("outputs", name, stamp)
    repeat = 1
    while True:
        try:
            folder.mkdir(parents=True)
            return folder
        except FileExistsError:  # of this process, or of another one that has just made it
            repeat += 1
            folder = folder.with_name(f"{stamp}_{repeat}")


def write_metrics(folder: Path, metrics: AnyMetrics, conditions: Mapping[str, Any] | None = None) -> Report:
    """Write the metrics of a run and its commit, versions and command, as `metrics.json` and `run.json`; return both.

    Each file is written atomically. Environment variables are not saved. NumPy
    scalars become Python numbers. folder: an existing folder; conditions: conditions of the evaluation by name. Raises
    InputError: a value is not finite. TypeError: a value has another type. Both name the metric.
    """
    known = {name: _to_python(name, value) for name, value in (conditions or {}).items()}
    converted = {key: _converted(key, value) for key, value in metrics.items()}
    report = Report(folder / "metrics.json", known, converted)
    command = [Path(sys.argv[0]).name, *sys.argv[1:]]
    run = source_versions() | {"device": device_info()._asdict(), "command": command}
    for name, content in (("run.json", run), ("metrics.json", report.to_json())):
        write_atomically(folder / name, json_bytes(content))
    return report


def read_report(folder: Path) -> Report:
    """Read the metrics and conditions of a run from its `metrics.json`."""
    path = folder / "metrics.json"
    document = json.loads(path.read_bytes())
    entries = document["metrics"].items()
    metrics = {key: MetricValue(*(entry[name] for name in MetricValue._fields)) for key, entry in entries}
    return Report(path, document["conditions"], metrics)


def read_values(folder: Path) -> dict[str, Any]:
    """Read the conditions of an evaluation and the values of its metrics from `metrics.json`, by name."""
    return read_report(folder).values


def _converted(key: str, value: Any) -> MetricValue:
    """Return a metric with Python numbers and lists. Raises TypeError or InputError as `write_metrics`."""
    metric = value if isinstance(value, MetricValue) else MetricValue(value)
    interval: Any = None if metric.interval is None else _to_python(key, list(metric.interval))
    return metric._replace(value=_to_python(key, metric.value), interval=interval)


def _to_python(name: str, value: Any) -> Scalar | list[Scalar]:
    """Convert a metric's value to a Python scalar or list. Raises TypeError or InputError as `write_metrics`."""
    if not isinstance(name, str):
        raise TypeError(f"the name of a metric must be a string, got {name!r}")
    if isinstance(value, list):
        return [_to_python_scalar(f"{name}[{index}]", item) for index, item in enumerate(value)]
    return _to_python_scalar(name, value)


def _to_python_scalar(name: str, value: Any) -> Scalar:
    """Convert a scalar of a metric to a Python object. Raises TypeError or InputError: another type, or not finite."""
    if isinstance(value, np.generic):
        value = value.item()
    if not isinstance(value, Scalar):
        raise TypeError(f"metric {name!r} must be a number, string or None, or a flat list, got {type(value).__name__}")
    if isinstance(value, float) and not math.isfinite(value):
        raise InputError(f"metric {name!r} is {value}: only finite numbers are reported")
    return value
