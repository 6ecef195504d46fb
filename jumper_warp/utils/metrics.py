"""Definitions of metrics, and their values with 95 % confidence intervals."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Mapping
from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import ArrayLike

Scalar = float | int | str | bool | None  # Type of a value, or of each item of a list of values
UNITS = {
    "_per_s": "1/s", "_n_m": "N/m", "_rad_s": "rad/s", "_m_s2": "m/s^2", "_nm_s": "N m s", "_m_s": "m/s", "_deg": "deg",
    "_rad": "rad", "_mm": "mm", "_ms": "ms", "_us": "us", "_nm": "N m", "_hz": "Hz", "_m": "m", "_s": "s", "_n": "N",
    "_j": "J",
}  # fmt: skip
"""Unit by the end of a metric's key; longer ends come before the shorter ones that they contain."""


class MetricValue(NamedTuple):
    """Value of an evaluation metric, with its confidence interval and number of trials."""

    value: Scalar | list[Scalar]  # None: undefined, such as a mean over no trials
    trials: int | None = None  # Number of trials; None: not computed from trials
    interval: tuple[float, float] | None = None  # 95 % confidence interval; None: undefined
    over: str | None = None  # The trials, such as "landed jumps"


AnyMetrics = Mapping[str, MetricValue | Scalar | list[Scalar]]  # Metrics by key, which ends in the unit
Metrics = dict[str, MetricValue]  # Metrics by key
Z = 1.959964  # [1] Two-sided 95 % quantile of the normal distribution
RESAMPLES, BOOTSTRAP_SEED = 2000, 0  # Number of bootstrap samples of each mean, and seed of their draws
BATCH = 4_000_000  # Number of values drawn at once, which limits the memory


class Outcome(Protocol):
    """Interface of an evaluation's results: arrays over trials from which metrics are computed."""

    @property
    def trials(self) -> Mapping[str, np.ndarray]:
        """Masks that select the trials from which a metric is computed, by name such as "landed jumps".

        Bool, shape of the arrays' first axes.
        """
        ...


class Metric(NamedTuple):
    """Definition of an evaluation metric: name, statistic and the trials that it is computed from."""

    key: str  # Name of the measured quantity; ends in the unit, if there is one
    statistic: Callable[[np.ndarray, str], MetricValue]  # `rate`, `mean`, `largest` or `rmse`
    over: str  # Set of trials, a name in `Outcome.trials`
    values: Callable[[Any], np.ndarray]  # Returns an array of an outcome, one entry per trial


def unit_of(key: str) -> str | None:
    """Return the unit in the name of a metric, such as m/s for `speed_m_s` or `speed [m/s]`; None: it has no unit."""
    return split_unit(key)[1]


def split_unit(key: str) -> tuple[str, str | None]:
    """Split the name of a metric into the name without its unit, and the unit, see `unit_of`."""
    if bracket := re.search(r" *\[(.+)\]$", key):
        return key[: bracket.start()], bracket[1]
    return next(((key.removesuffix(end), unit) for end, unit in UNITS.items() if key.endswith(end)), (key, None))


def measure(
    table: Iterable[Metric], outcome: Outcome, where: np.ndarray | None = None, prefix: str = "", note: str = ""
) -> Metrics:
    """Compute metrics, given by their definitions, from the results of an evaluation.

    Returned by key, each with `prefix` before it. where: mask of the trials to use, default: all; note: description of
    these trials, for the file.
    """
    metrics = {}
    for key, statistic, over, values in table:
        mask = outcome.trials[over] if where is None else outcome.trials[over] & where
        metrics[prefix + key] = statistic(values(outcome)[mask], f"{over} {note}".strip())
    return metrics


def chosen(table: Iterable[Metric], *keys: str) -> list[Metric]:
    """Select the metric definitions with these keys, in their order; keys that the table lacks are skipped."""
    rows = {metric.key: metric for metric in table}
    return [rows[key] for key in keys if key in rows]


def rate(values: ArrayLike, over: str = "") -> MetricValue:
    """Return the fraction of true values (n,) as a metric with Wilson's 95 % interval; over: the trials, as text."""
    values = np.asarray(values, dtype=bool)
    n = values.size
    p = float(values.mean()) if values.size else None
    if p is None:
        return MetricValue(None, 0, None, over)
    scale = 1.0 + Z * Z / n
    center = p + 0.5 * Z * Z / n
    half = Z * np.sqrt(p * (1.0 - p) / n + (0.5 * Z / n) ** 2)
    low = (center - half) / scale
    high = (center + half) / scale
    return MetricValue(p, n, (max(float(low), 0.0), min(float(high), 1.0)), over)


def mean(values: ArrayLike, over: str = "") -> MetricValue:
    """Return the mean of the finite values as a metric with a bootstrap interval; over: the trials, as text."""
    values = np.asarray(values, dtype=float).ravel()
    known = np.isfinite(values)
    return _ratio(np.stack([np.where(known, values, 0.0), known], axis=1), over)


def rmse(squares: np.ndarray, over: str = "") -> MetricValue:
    """Return the root mean square error over all samples as a metric, with a bootstrap interval over trials.

    squares: (trials, 2), sum of squared errors and number of samples of each trial.
    """
    return _ratio(np.asarray(squares, dtype=float), over, np.sqrt)


def _ratio(rows: np.ndarray, over: str, function: Callable[[Any], Any] = lambda ratio: ratio) -> MetricValue:
    """Return a metric, `function` of the ratio of two columns' sums, with a bootstrap interval over the rows.

    Whole trials are resampled, since the samples of one trial depend on each other. rows: (trials, 2), the second
    column numbers of samples; function: of the ratio.
    """
    rows = rows[rows[:, 1] > 0]
    if not len(rows):
        return MetricValue(None, 0, None, over)
    total = rows.sum(axis=0)
    means = resampled_means(rows)
    low, high = np.quantile(function(means[:, 0] / means[:, 1]), (0.025, 0.975))
    return MetricValue(float(function(total[0] / total[1])), len(rows), (float(low), float(high)), over)


def largest(values: ArrayLike, over: str = "") -> MetricValue:
    """Return the largest of the finite values as a metric; over: the trials, as text."""
    values = np.asarray(values, dtype=float).ravel()
    values = values[np.isfinite(values)]
    return MetricValue(float(values.max()) if len(values) else None, len(values), None, over)


def resampled_means(rows: np.ndarray) -> np.ndarray:
    """Return the column means (RESAMPLES, columns) of bootstrap samples that are drawn from rows (n, columns).

    The seed is fixed, so that equal results have equal intervals.
    """
    rng = np.random.default_rng(BOOTSTRAP_SEED)
    n = len(rows)
    at_once = max(1, min(RESAMPLES, BATCH // n))
    sizes = [min(at_once, RESAMPLES - done) for done in range(0, RESAMPLES, at_once)]
    return np.concatenate([rows[rng.integers(0, n, (size, n))].mean(axis=1) for size in sizes])


def format_value(value: Any) -> str:
    """Return a value as text; floats, also in lists, have four significant digits, from 1000 on no decimals.

    None is "undefined".
    """
    if isinstance(value, list):
        return ", ".join(format_value(item) for item in value)
    if isinstance(value, float):
        return f"{value:,.0f}" if abs(value) >= 1.0e3 else f"{value:.4g}"
    return "undefined" if value is None else str(value)
