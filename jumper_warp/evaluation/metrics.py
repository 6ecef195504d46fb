"""Tables of metrics, their values with 95 % confidence intervals, and how a terminal shows them."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import ArrayLike
from rich.console import Console
from rich.table import Table

from jumper_warp.utils.output import AnyMetrics, MetricValue

Metrics = dict[str, MetricValue]  # Metrics by key
Z = 1.959964  # [1] Two-sided 95 % quantile of the normal distribution
RESAMPLES, BOOTSTRAP_SEED = 2000, 0  # Number of bootstrap samples of each mean, and seed of their draws
BATCH = 4_000_000  # Number of values drawn at once, which limits the memory
WIDTH = 80  # Characters in a line of a printed table


class Outcome(Protocol):
    """Arrays of trials that metrics are computed from."""

    @property
    def trials(self) -> Mapping[str, np.ndarray]:
        """Sets of trials by name, such as "landed jumps": bool, of the shape of the arrays' first axes."""
        ...


class Metric(NamedTuple):
    """Definition of a metric: a row of a table."""

    key: str  # Says what is measured; ends in the unit, if there is one
    statistic: Callable[[np.ndarray, str], MetricValue]  # `rate`, `mean`, `largest` or `rmse`
    over: str  # Set of trials, a name in `Outcome.trials`
    values: Callable[[Any], np.ndarray]  # Returns an array of an outcome, one entry per trial


def measure(
    table: Iterable[Metric], outcome: Outcome, where: np.ndarray | None = None, prefix: str = "", note: str = ""
) -> Metrics:
    """Return the metrics of a table by key, each with `prefix` before it.

    where: mask of the trials that count, default: all; note: says which these are, for the file.
    """
    metrics = {}
    for key, statistic, over, values in table:
        mask = outcome.trials[over] if where is None else outcome.trials[over] & where
        metrics[prefix + key] = statistic(values(outcome)[mask], f"{over} {note}".strip())
    return metrics


def chosen(table: Iterable[Metric], *keys: str) -> list[Metric]:
    """Return the rows of a table with these keys, in their order; keys that it lacks are skipped."""
    rows = {metric.key: metric for metric in table}
    return [rows[key] for key in keys if key in rows]


def rate(values: ArrayLike, over: str = "") -> MetricValue:
    """Return the fraction of true values (n,), with Wilson's interval; over: what the trials are."""
    values = np.asarray(values, dtype=bool)
    n, p = values.size, float(values.mean()) if values.size else None
    if p is None:
        return MetricValue(None, 0, None, over)
    scale = 1.0 + Z * Z / n
    center, half = p + 0.5 * Z * Z / n, Z * np.sqrt(p * (1.0 - p) / n + (0.5 * Z / n) ** 2)
    low, high = (center - half) / scale, (center + half) / scale
    return MetricValue(p, n, (max(float(low), 0.0), min(float(high), 1.0)), over)


def mean(values: ArrayLike, over: str = "") -> MetricValue:
    """Return the mean of the values (n,) that are finite, with a bootstrap interval; over: what the trials are."""
    values = np.asarray(values, dtype=float).ravel()
    values = values[np.isfinite(values)]
    if not len(values):
        return MetricValue(None, 0, None, over)
    low, high = np.quantile(resampled_means(values[:, None]), (0.025, 0.975))
    return MetricValue(float(values.mean()), len(values), (float(low), float(high)), over)


def rmse(squares: np.ndarray, over: str = "") -> MetricValue:
    """Return the root mean square over all samples of all trials, with a bootstrap interval over trials.

    squares: (trials, 2), sum of squared errors and number of samples of each trial.
    """
    squares = np.asarray(squares, dtype=float)[squares[:, 1] > 0]
    if not len(squares):
        return MetricValue(None, 0, None, over)
    total, means = squares.sum(axis=0), resampled_means(squares)
    low, high = np.quantile(np.sqrt(means[:, 0] / means[:, 1]), (0.025, 0.975))
    return MetricValue(float(np.sqrt(total[0] / total[1])), len(squares), (float(low), float(high)), over)


def largest(values: ArrayLike, over: str = "") -> MetricValue:
    """Return the largest of the finite values; over: what the trials are."""
    values = np.asarray(values, dtype=float).ravel()
    values = values[np.isfinite(values)]
    return MetricValue(float(values.max()) if len(values) else None, len(values), None, over)


def resampled_means(rows: np.ndarray) -> np.ndarray:
    """Return the means of RESAMPLES bootstrap samples of rows (n, columns), (RESAMPLES, columns)."""
    rng, n = np.random.default_rng(BOOTSTRAP_SEED), len(rows)
    at_once = max(1, min(RESAMPLES, BATCH // n))
    sizes = [min(at_once, RESAMPLES - done) for done in range(0, RESAMPLES, at_once)]
    return np.concatenate([rows[rng.integers(0, n, (size, n))].mean(axis=1) for size in sizes])


def print_metrics(
    metrics: AnyMetrics, paper: Mapping[str, float] | None = None, conditions: Mapping[str, Any] | None = None,
    title: str = "",
) -> None:  # fmt: skip
    """Print conditions and metrics with intervals beside the paper's values, at most WIDTH characters a line.

    Metrics whose value is a list are left out.
    """
    console, conditions = Console(width=WIDTH), conditions or {}
    table = Table("metric", "value", "95 % interval", *(["paper"] if paper else []), box=None, pad_edge=False)
    for key, entry in metrics.items():
        value, _, interval, _ = entry if isinstance(entry, MetricValue) else MetricValue(entry)
        if not isinstance(value, list):
            limits = "" if interval is None else "{:.4g} to {:.4g}".format(*interval)
            known = [f"{paper[key]:g}" if key in paper else ""] if paper else []
            table.add_row(key, format_value(value), limits, *known)
    if title:
        console.print(title)
    if conditions:
        text = "; ".join(f"{name} {format_value(value)}" for name, value in conditions.items())
        console.print(text, highlight=False)
    console.print(table)


def format_value(value: Any) -> str:
    """Return a value as text; floats, also in lists, have four significant digits."""
    if isinstance(value, list):
        return ", ".join(format_value(item) for item in value)
    return f"{value:.4g}" if isinstance(value, float) else str(value)
