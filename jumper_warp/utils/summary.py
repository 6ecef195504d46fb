"""Printed summary of results: what was done, the main metrics beside published values, and the paths of files."""

from __future__ import annotations

import os
import re
import textwrap
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import tyro
from rich.table import Column, Table

from jumper_warp.utils.files import json_bytes
from jumper_warp.utils.metrics import MetricValue, format_value, split_unit
from jumper_warp.utils.output import Report
from jumper_warp.utils.tables import WIDTH, print_table

KINDS = {"picture": (".png", ".webp"), "film": (".mp4", ".gif"), "recording": (".rrd",), "folder": ("",)}
"""Ends of the names of files by kind, in the order of the summary."""
IN_RANGE = "in_range_"  # Prefix of metrics of the goals within a range
NO_END, TIME_LIMIT = "no_end", "time limit"  # Outcome of a trial that had not ended: in metrics.json, as printed
MOST_COLUMNS = 6  # Number of trials above which their values share one column
MOST_PATHS = 3  # Number of files of a kind above which only their folder is printed


@dataclass(frozen=True, kw_only=True)
class PrintFlags:
    """Options that select what is printed about a run's results."""

    verbose: tyro.conf.FlagCreatePairsOff[bool] = False  # Print all metrics in place of a summary
    json: tyro.conf.FlagCreatePairsOff[bool] = False  # Print metrics.json in place of a summary


def print_summary(
    report: Report,
    title: str,
    keys: Iterable[str],
    *,
    seconds: float,
    paper: Mapping[str, float] | None = None,
    flags: PrintFlags | None = None,
    trial: str = "trial",
    films: Iterable[Path] = (),
) -> None:
    """Print a summary of a run: title, main metrics (by `keys`) and paths of its files, 80 columns wide.

    title: what was done; keys: of the main metrics, those that the report lacks are skipped; seconds: wall time of the
    run; paper: published values by key; flags: print all metrics, or the file itself; trial: noun for the items of
    metrics that are lists; films: films of the run, in any folder.
    """
    flags = flags or PrintFlags()
    paper = paper or {}
    if flags.json:
        print(json_bytes(report.to_json()).decode(), end="")
        return
    metrics = report.metrics
    folder = report.path.parent
    main = metrics if flags.verbose else {key: metrics[key] for key in keys if key in metrics}
    print(textwrap.fill(title, WIDTH))
    if flags.verbose and report.conditions:
        conditions = (f"{name} {format_value(value)}" for name, value in report.conditions.items())
        print(textwrap.fill("; ".join(conditions), WIDTH))
    if main:
        print_table(_columns_table(main, trial) if _has_columns(main) else _summary_table(main, paper))
    hints = ["rerun FILE shows a recording"] if any(folder.glob("*.rrd")) else []
    hints += [f"--verbose prints {len(metrics)} metrics"] if len(metrics) > len(main) else []
    end = "; ".join([f"{'time':9}  {seconds:.0f} s", *hints])
    print(*_file_lines(folder, list(films)), f"{'metrics':9}  {report.path}", end, sep="\n")


def _summary_table(metrics: Mapping[str, MetricValue], paper: Mapping[str, float]) -> Table:
    """Return a printable table of metrics in words, with units, beside the paper's values if there are any."""
    intervals = any(metric.interval for metric in metrics.values())
    published = bool(paper.keys() & metrics.keys())
    columns = [Column("", overflow="fold"), "value", *["95 % interval"] * intervals, *["paper"] * published]
    table = Table(*columns, box=None, pad_edge=False)
    for key, metric in metrics.items():
        low_high = [] if metric.interval is None else [_text(key, limit) for limit in metric.interval]
        row = [_text(key, metric.value, unit=True), *[" to ".join(low_high)] * intervals]
        table.add_row(_words(key, metric), *row, *[_text(key, paper.get(key, ""))] * published)
    return table


def _has_columns(metrics: Mapping[str, MetricValue]) -> bool:
    """Return whether each metric is a list of one value per trial, for few trials."""
    sizes = {len(metric.value) if isinstance(metric.value, list) else 0 for metric in metrics.values()}
    return len(sizes) == 1 and 0 < max(sizes) <= MOST_COLUMNS


def _columns_table(metrics: Mapping[str, MetricValue], trial: str) -> Table:
    """Return a printable table of metrics in words, with units, and a column for each trial."""
    values = {key: metric.value for key, metric in metrics.items() if isinstance(metric.value, list)}
    names = [f"{trial} {i + 1}" for i in range(len(next(iter(values.values()))))]
    table = Table("", *names, box=None, pad_edge=False)
    for key, row in values.items():
        table.add_row(_words(key, metrics[key]), *(_text(key, value, unit=True) for value in row))
    return table


def _words(key: str, metric: MetricValue) -> str:
    """Return a metric's name in words, such as "apex error, mean size"; metrics of a range of goals name the range."""
    name = split_unit(key)[0].removeprefix(IN_RANGE).replace("_", " ")
    name = re.sub(r"( abs)? (mean|max|median)$", lambda found: f", {found[2]}" + " size" * bool(found[1]), name)
    name = re.sub(r"^command (\d)$", r"command value \1, in the task's unit", name)
    goals = re.sub(r"^jumps (with goals of )?", "", metric.over or "")
    name = re.sub(r"^ended by (.*) rate$", r"ended by \1", name).replace("by no end", f"by {TIME_LIMIT}")
    name, training = re.subn(r"^(within|beyond) training ", "", name)
    return f"{name}, {goals}" if training or key.startswith(IN_RANGE) else name


def _text(key: str, value: Any, *, unit: bool = False) -> str:
    """Return a metric's value as text, a rate in percent; unit: append the unit of the metric's key."""
    if value is None:
        return "undefined"
    if value == NO_END:
        return TIME_LIMIT
    percent = key.endswith("_rate") and not key.endswith("yaw_rate") and isinstance(value, float | int)
    text, of = (format_value(100.0 * value), "%") if percent else (format_value(value), split_unit(key)[1])
    return f"{text} {of}" if unit and of else text


def _file_lines(folder: Path, films: Sequence[Path]) -> Iterable[str]:
    """Yield a printed line for each picture, film, recording and folder in a folder, or one for each kind with many.

    films: a line for each of these, which may have the suffix of a picture.
    """
    yield from (f"{'film':9}  {path}" for path in films)
    known = {os.path.realpath(path) for path in films}
    paths = [path for path in folder.iterdir() if os.path.realpath(path) not in known]  # `resolve` refuses link loops
    for kind, ends in KINDS.items():
        found = sorted(path for path in paths if path.suffix in ends and path.is_dir() == (kind == "folder"))
        if len(found) > MOST_PATHS:
            yield f"{kind + 's':9}  {len(found)} in {folder}"
        else:
            yield from (f"{kind:9}  {path}" for path in found)
