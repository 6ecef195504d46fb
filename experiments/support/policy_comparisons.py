"""Comparisons of results of the shipped policies: between two seeds, and between old and new definitions of metrics."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import scipy.stats

from jumper_warp.tasks.cfg import TaskCfg
from jumper_warp.utils.metrics import MetricValue, Z
from support.policy_conditions import CONDITIONS
from support.policy_results import Row, earlier_metrics, kind_of, markdown, number

LEAST = 20  # Least number of trials of a metric that is tested
LEVEL = 0.01  # [1] Level of significance after correction


class SeedTest(NamedTuple):
    """Significance test of the difference of one metric between two seeds."""

    policy: str
    condition: str
    key: str
    values: tuple[Any, Any]
    p: float  # Two-sided


class OldKey(NamedTuple):
    """Old and new key of a metric whose definition or name changed."""

    title: str
    old: str
    new: str
    change: str = ""  # Difference of the definitions; empty: none


OLD_SUITES = {
    "nominal": ("nominal", "straight", "ring"), "randomised": ("randomised", "straight_randomised", "ring_randomised"),
    "mujoco": ("mujoco", "straight_mujoco", "ring_mujoco"), "friction_0.4": ("friction_0.4",),
    "gains_0.6": ("gains_0.6",),
}  # fmt: skip
"""Names of the old suites by condition."""
OLD_KEYS = {
    "height": (
        OldKey("success", "success_rate", "success_rate",
               "old: the apex alone; new: on command, apex, landing without a fall, rest within a second"),
        OldKey("reached", "success_rate", "goal_reached_rate"),
        OldKey("success and landing → success", "success_and_landing_rate", "success_rate",
               "old: also tilted by less than 10°; new: also on command"),
        OldKey("still", "still_landing_rate", "no_paw_lift_rate"),
        OldKey("apex error, size [m]", "mean_abs_error_m", "apex_error_abs_mean_m",
               "new: apex from takeoff to touchdown; a tilt of 25° does not end the jump"),
        OldKey("apex error, signed [m]", "mean_error_m", "apex_error_signed_mean_m",
               "old key without the sign; otherwise as the size"),
        OldKey("falls", "fall_rate", "fall_rate", "old: a tilt of 25° counts as a fall"),
    ),
    "place": (
        OldKey("success", "success_rate", "success_rate", "new: also at rest within a second; "
               "contact shortly after the command is no takeoff"),
        OldKey("success without a paw lifted", "step_free_success_rate", "success_without_paw_lift_rate",
               "as success"),
        OldKey("error at the end → at rest [m]", "mean_error_m", "goal_distance_at_rest_mean_m",
               "old: failed jumps count; new: landed jumps, from the real touchdown"),
        OldKey("error at touchdown [m]", "mean_error_at_touchdown_m", "goal_distance_at_touchdown_mean_m",
               "new: contact shortly after the command is no takeoff"),
        OldKey("falls", "fall_rate", "fall_rate"),
    ),
    "velocity": (
        *(OldKey(f"RMSE {axis}, settled", f"rmse_{axis}_{unit}", f"settled_rmse_{axis}_{unit}")
          for axis, unit in (("vx", "m_s"), ("vy", "m_s"), ("yaw_rate", "rad_s"))),
        *(OldKey(f"RMSE {axis}, all time", f"rmse_{axis}_{unit}", f"rmse_{axis}_{unit}",
                 "old: without the first second after a command; new: all time")
          for axis, unit in (("vx", "m_s"), ("vy", "m_s"), ("yaw_rate", "rad_s"))),
        OldKey("falls", "fall_rate", "fall_rate"),
    ),
    "attitude": (
        OldKey("settled", "success_rate", "settled_without_collision_rate"),
        OldKey("settling time [s]", "mean_settling_s", "settling_time_mean_s"),
        OldKey("error at the end [deg]", "mean_error_at_end_deg", "error_at_end_mean_deg"),
    ),
}  # fmt: skip
"""Pairs of keys by `kind_of` a task."""
OLD_COMMANDS = {
    "velocity": "old: one command a robot; new: three, each for 3 s",
    "mars_vertical_jump": "old: heights of 0.8 to 3.6 m; new: 1 to 3.3 m",
    "mars_vertical_jump_stock": "old: heights of 0.8 to 2.9 m; new: 1 to 3.3 m",
    "omnidirectional_jump": "old: goals on a ring of 0.7 m; new: goals in a square of ±0.7 m",
}
"""Differences of the commands, by kind of task or policy."""


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
        f"{compared} rows have two seeds. They give {count:,} tests: two-proportion tests of rates, Welch's t-tests of "
        f"means.\nA difference is significant if p × {count:,} is below {LEVEL:g} (Bonferroni). "
        f"**{len(significant)} differences are significant.**\n"
        + ("" if significant else "The smallest p of all tests are these:\n")
    )
    lines = [
        [test.policy, _words(test.condition), f"`{test.key}`", *(number(test.key, value) for value in test.values),
         f"{test.p:.2g}", f"{min(test.p * count, 1.0):.2g}"]
        for test in significant or tests[:3]
    ]  # fmt: skip
    return (
        text
        + "\n"
        + markdown(("policy", "condition", "metric", "first seed", "second seed", "p", "corrected p"), lines)
    )


def _words(condition: str) -> str:
    """Return a test condition in words, with its solver if that is SolverMuJoCo."""
    known = CONDITIONS[condition]
    return known.words + (", SolverMuJoCo" if known.values.get("solver") == "mujoco" else "")


def old_section(rows: Sequence[Row], tasks: Mapping[str, TaskCfg]) -> str:
    """Return the tables that compare old and new definitions of metrics, one for each kind of task.

    rows: of one seed.
    """
    sections = []
    for kind, keys in OLD_KEYS.items():
        lines = [line for row in rows if kind_of(tasks[row.policy]) == kind if (line := _old_line(row, tasks, keys))]
        if not lines:
            continue
        reasons = [f"{key.title}: {key.change}" for key in keys if key.change]
        titles = ["policy", "condition", "trials", *(key.title for key in keys), "C: other commands"]
        sections += [markdown(titles, lines), *(f"- D, {reason}" for reason in reasons), ""]
    return "\n".join(sections)


def _old_line(row: Row, tasks: Mapping[str, TaskCfg], keys: Sequence[OldKey]) -> list[str]:
    """Return one policy's line in a table of old and new metrics, empty if its condition has no old metrics."""
    suites = earlier_metrics(row.policy)
    names = [name for name in OLD_SUITES.get(row.condition, ()) if name in suites]
    old: dict[str, Any] = suites[names[0]] if names else {}
    if not any(key.old in old for key in keys):
        return []
    commands = OLD_COMMANDS.get(kind_of(tasks[row.policy]), OLD_COMMANDS.get(row.policy, ""))
    trials = next((old[name] for name in ("jumps", "robots", "turns") if name in old), None)
    new_trials = max(metric.trials or 0 for metric in row.metrics.values())
    cells = [_old_cell(key, old.get(key.old), row.metrics[key.new], bool(commands)) for key in keys]
    return [row.policy, _words(row.condition), f"{trials:,} → {new_trials:,}", *cells, commands]


def _old_cell(key: OldKey, old: float | None, new: MetricValue, other_commands: bool) -> str:
    """Format the old and the new value of a metric for a table.

    Letters give the reasons if the old one is outside the new interval.
    """
    if old is None or not isinstance(new.value, int | float):
        return "–"
    low, high = new.interval or (new.value, new.value)
    reasons = ("D" if key.change else "") + ("C" if other_commands else "")
    letters = "" if low <= old <= high else f" {reasons or 'S'}"
    return f"{number(key.new, old)} → {number(key.new, new.value)}{letters}"
