"""Significance of differences between two seeds of the results of the shipped policies."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import scipy.stats

from jumper_warp.utils.metrics import MetricValue, Z
from support.policy_conditions import CONDITIONS
from support.policy_results import Row
from support.policy_tables import markdown, number

LEAST = 20  # Least number of trials of a metric that is tested
LEVEL = 0.01  # [1] Level of significance after correction


class SeedTest(NamedTuple):
    """Significance test of the difference of one metric between two seeds."""

    policy: str
    condition: str
    key: str
    values: tuple[Any, Any]
    p: float  # Two-sided


def proportions_p(a: MetricValue, b: MetricValue) -> float:
    """Return the two-sided p-value of the hypothesis that two rates are equal.

    It is the two-proportion test with pooled variance.
    """
    (p, n), (q, m) = _value_and_trials(a), _value_and_trials(b)
    pooled = (p * n + q * m) / (n + m)
    error = math.sqrt(pooled * (1.0 - pooled) * (1.0 / n + 1.0 / m))
    return 1.0 if error == 0.0 else 2.0 * float(scipy.stats.norm.sf(abs(p - q) / error))


def means_p(a: MetricValue, b: MetricValue) -> float:
    """Return the two-sided p-value of the hypothesis that two means are equal, by Welch's t-test.

    Standard errors follow from the 95 % intervals.
    """
    (p, n), (q, m) = _value_and_trials(a), _value_and_trials(b)
    v, w = (((x.interval[1] - x.interval[0]) / (2.0 * Z)) ** 2 if x.interval else 0.0 for x in (a, b))
    if v + w == 0.0:
        return 1.0 if p == q else 0.0
    freedom = (v + w) ** 2 / (v**2 / (n - 1) + w**2 / (m - 1))
    return 2.0 * float(scipy.stats.t.sf(abs(p - q) / math.sqrt(v + w), freedom))


def _value_and_trials(metric: MetricValue) -> tuple[float, int]:
    """Return value and number of trials of a metric that has both."""
    assert isinstance(metric.value, int | float) and metric.trials is not None
    return float(metric.value), metric.trials


def seed_tests(rows: Sequence[Row]) -> list[SeedTest]:
    """Test every metric for a difference between the first two seeds of each policy and condition.

    Metrics without an interval or with fewer than LEAST trials are left out.
    """
    pairs: dict[tuple[str, str], list[Row]] = {}
    for row in rows:
        pairs.setdefault(row[:2], []).append(row)
    tests = []
    for (policy, condition), (first, *others) in pairs.items():
        for key, a in first.metrics.items() if others else ():
            b = others[0].metrics.get(key, MetricValue(None))
            if a.interval and b.interval and min(a.trials or 0, b.trials or 0) >= LEAST:
                p = (proportions_p if key.endswith("_rate") else means_p)(a, b)
                tests.append(SeedTest(policy, condition, key, (a.value, b.value), p))
    return tests


def seed_section(rows: Sequence[Row]) -> str:
    """Return the text that compares two seeds: number of tests, and differences significant at LEVEL."""
    tests = sorted(seed_tests(rows), key=lambda test: test.p)
    if not tests:
        return f"No row has two seeds and at least {LEAST} trials.\n"
    count, compared = len(tests), len({test[:2] for test in tests})
    significant = [test for test in tests if test.p * count < LEVEL]
    text = (
        f"{compared} rows were measured with two seeds. Each of their {count:,} rates and means was compared:\n"
        "rates by two-proportion tests, means by Welch's t-tests.\n"
        f"{len(significant)} differences are significant (p-value times the number of tests below {LEVEL:g}). "
        + ("These are:\n" if significant else "The smallest p-values are:\n")
    )
    lines = [
        [test.policy, CONDITIONS[test.condition].title, f"`{test.key}`",
         *(number(test.key, value) for value in test.values), f"{test.p:.2g}", f"{min(test.p * count, 1.0):.2g}"]
        for test in significant or tests[:3]
    ]  # fmt: skip
    titles = ("policy", "condition", "metric", "first seed", "second seed", "p", "corrected p")
    return text + "\n" + markdown(titles, lines)
