"""Creation of output folders; writing and reading of `metrics.json` (layout: docs/metrics.schema.json)."""

import math
import sys
from collections.abc import Mapping
from datetime import datetime
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from jumper_warp.utils.errors import InputError
from jumper_warp.utils.files import Json, json_bytes, read_json, write_atomically
from jumper_warp.utils.metrics import AnyMetrics, MetricValue, unit_of
from jumper_warp.utils.runtime import device_info, source_versions

VERSION = 1  # Version of the layout of metrics.json


class Report(NamedTuple):
    """Metrics of a run with the conditions in which they were measured, and the file that holds both."""

    path: Path  # of metrics.json
    conditions: Json  # conditions of the evaluation by name
    metrics: dict[str, MetricValue]  # values are Python numbers, strings, None, or lists of these

    @property
    def values(self) -> Json:
        """Conditions, and values of the metrics without intervals, by name."""
        return self.conditions | {key: metric.value for key, metric in self.metrics.items()}

    def to_json(self) -> Json:
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
        Path(out).mkdir(parents=True, exist_ok=True)
        return Path(out)
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
    InputError: a value is not finite. TypeError: JSON cannot hold it.
    """
    folder = Path(folder)
    known = {name: _plain(name, value) for name, value in (conditions or {}).items()}
    converted = {}
    for key, value in metrics.items():
        metric = value if isinstance(value, MetricValue) else MetricValue(value)
        interval = metric.interval and _plain(key, list(metric.interval))
        converted[key] = metric._replace(value=_plain(key, metric.value), interval=interval)
    report = Report(folder / "metrics.json", known, converted)
    command = [Path(sys.argv[0]).name, *sys.argv[1:]]
    run = source_versions() | {"device": device_info()._asdict(), "command": command}
    for name, content in (("run.json", run), ("metrics.json", report.to_json())):
        write_atomically(folder / name, json_bytes(content))
    return report


def read_values(folder: Path) -> Json:
    """Read the conditions of an evaluation and the values of its metrics from `metrics.json`, by name.

    Raises InputError: the file is missing or damaged.
    """
    path = Path(folder) / "metrics.json"
    document = read_json(path, "metrics of an evaluation")
    try:
        return document["conditions"] | {key: entry["value"] for key, entry in document["metrics"].items()}
    except (LookupError, TypeError, AttributeError):
        raise InputError(f"{path}: not the metrics of an evaluation") from None


def _plain(name: str, value: Any) -> Any:
    """Convert a scalar, or each item of a list, to a Python object. Raises InputError: a number is not finite."""
    if isinstance(value, list):
        return [_plain(f"{name}[{index}]", item) for index, item in enumerate(value)]
    value = value.item() if isinstance(value, np.generic) else value
    if isinstance(value, float) and not math.isfinite(value):
        raise InputError(f"metric {name!r} is {value}: only finite numbers are reported")
    return value
