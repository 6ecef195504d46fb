"""Comparison of trainings: learning curves, evaluation metrics, reward terms and differing settings of arms.

One primary metric is tested, by an exact rank test of each arm against the first one, the base, with Holm's correction
for their number. All other metrics are exploratory: they have intervals but no test.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property, partial
from pathlib import Path
from types import ModuleType
from typing import Any, NamedTuple

import numpy as np

from jumper_warp.compare import statistics
from jumper_warp.compare.arms import Arm, differences, find_arms, of_equal_length
from jumper_warp.evaluation.conditions import Conditions
from jumper_warp.evaluation.run import EvaluationRun
from jumper_warp.policies.catalog import ERRORS, SUCCESSES
from jumper_warp.tasks.cfg import TaskCfg
from jumper_warp.utils.checks import check_flags
from jumper_warp.utils.errors import InputError
from jumper_warp.utils.files import Json
from jumper_warp.utils.progress import phase
from jumper_warp.utils.runtime import configure_device

OVERALL = [name for name in (*SUCCESSES, "success_termination_rate", *ERRORS) if not name.startswith("in_range_")]
PRIMARY = tuple(f"-{name}" if name in ERRORS else name for name in OVERALL)
"""Default primary metrics, of which the first one that an evaluation has counts; -: smaller is better."""
Values = dict[str, np.ndarray]  # Metrics of an arm by name, one value a seed


class Row(NamedTuple):
    """Metric of an arm, over its seeds, beside the base's."""

    metric: str
    arm: str
    values: np.ndarray  # (seeds,)
    mean: float  # interquartile mean
    interval: tuple[float, float]  # 95 % bootstrap interval of the mean
    improvement: float | None  # probability [1] that a seed is better than one of the base; None: the base itself
    improvement_interval: tuple[float, float] | None
    p_value: float | None  # exact rank test against the base, Holm-corrected; None: not the primary metric

    @property
    def verdict(self) -> str:
        """Result of the test in words; empty: no test."""
        if self.p_value is None or self.improvement is None:
            return ""
        if self.p_value >= 0.05:
            return "not shown"
        return "better" if self.improvement > 0.5 else "worse"


@dataclass(frozen=True)
class Comparison:
    """Result of `compare`; the first arm is the base."""

    arms: tuple[Arm, ...]
    evaluated: tuple[Values, ...]  # metrics of the evaluation of each arm; empty dicts: not evaluated
    curve_metric: str  # logged metric of the learning curves
    primary_name: str  # metric of the test, with a minus sign if smaller is better
    conditions: Json = field(default_factory=dict)  # of the evaluation by name; empty: not evaluated
    title: str = "Comparison"

    @property
    def metric(self) -> str:
        """Name of the primary metric."""
        return self.primary_name.removeprefix("-")

    @cached_property
    def primary(self) -> list[Row]:
        """Primary metric of each arm, with the test of each against the base."""
        values = [self.values_of(arm, self.metric) for arm in range(len(self.arms))]
        tests = statistics.holm([statistics.rank_test(values[0], other) for other in values[1:]])
        rows = self._rows([self.metric], lambda arm, _: values[arm])
        return [row._replace(p_value=p) for row, p in zip(rows, [None, *tests], strict=True)]

    @cached_property
    def exploratory(self) -> list[Row]:
        """Other evaluation metrics of each arm, without tests."""
        names = [name for name in self.evaluated[0] if name != self.metric and all(name in v for v in self.evaluated)]
        return self._rows(names, lambda arm, name: self.evaluated[arm][name])

    @cached_property
    def rewards(self) -> list[Row]:
        """Last logged reward terms of each arm, those of all arms in one order, without tests."""
        names = list(dict.fromkeys(name for arm in self.arms for name in arm.terms))
        return self._rows(names, lambda arm, name: self.arms[arm].terms.get(name, np.zeros(0)))

    @property
    def table(self) -> list[Row]:
        """All rows: primary metric, exploratory metrics, reward terms."""
        return [*self.primary, *self.exploratory, *self.rewards]

    @property
    def differences(self) -> dict[str, list[Any]]:
        """Settings that differ between arms by flag name, a value for each arm."""
        return differences([arm.settings for arm in self.arms])

    @property
    def fewest_seeds(self) -> int:
        """Number of seeds of the arm that has the fewest."""
        return min(len(row.values) for row in self.primary)

    def values_of(self, arm: int, metric: str) -> np.ndarray:
        """Return a metric of the evaluation, else of the log, of an arm's seeds. Raises InputError: none has it."""
        return _metric_of(self.arms[arm], self.evaluated[arm], metric)

    def _rows(self, names: Sequence[str], values: Callable[[int, str], np.ndarray]) -> list[Row]:
        """Return the rows of metrics, metric after metric, without tests; values: of an arm's seeds by its index."""
        rows = []
        for name in names:
            base = values(0, name)
            for index, arm in enumerate(self.arms):
                if not len(own := values(index, name)):
                    continue
                low, high = statistics.bands(own)
                better = (-own, -base) if self.primary_name == f"-{name}" else (own, base)
                improvement = float(statistics.probability_larger(*better)) if index and len(base) else None
                interval = None if improvement is None else statistics.probability_interval(*better)
                mean = float(statistics.interquartile_mean(own))
                rows.append(Row(name, arm.name, own, mean, (float(low), float(high)), improvement, interval, None))
        return rows


def compare(
    *sources: str | Path,
    metric: str = "",
    primary: str = "",
    evaluate: bool = True,
    evaluation: Mapping[str, Any] | None = None,
    conditions: Conditions | None = None,
    modules: Sequence[ModuleType] = (),
    title: str = "Comparison",
) -> Comparison:
    """Compare arms: runs, groups of runs of several seeds, or policies; the first is the base.

    sources: see `find_arms`. metric: logged one of the learning curves (default: the one that selects checkpoints).
    primary: metric that is tested, of the evaluation or the log, with a minus sign if smaller is better (default: the
    first of PRIMARY that the evaluation has, else `metric`). evaluate: run the evaluation of the best checkpoint of
    every seed, as `jumper evaluate`, with the commands and terminations of the base's task. evaluation: changed flags
    of `jumper evaluate` by name, such as num_jumps. conditions: of the evaluation (default: nominal). modules: the
    user's task modules.
    Raises InputError: fewer than two arms, or see `find_arms`; PolicyError: a policy cannot be evaluated.
    """
    check_flags(evaluate=evaluate)
    arms = of_equal_length(find_arms(sources))
    if len(arms) < 2:
        names = ", ".join(arm.name for arm in arms)
        raise InputError(f"a comparison needs two arms, got {names}; name them: NAME=RUN OTHER=RUN")
    if metric and not any(len(arm.last(metric)) for arm in arms):
        raise InputError(
            f"no run has logged {metric}; {arms[0].name} has logged {', '.join(arms[0].members[0].last) or 'nothing'}"
        )
    conditions = conditions or Conditions()
    configure_device(conditions.device, conditions.threads)
    evaluated: list[Values] = [{} for _ in arms]
    if evaluate:
        test = EvaluationRun(arms[0].members[0].folder, modules).task
        evaluated = [_evaluate(arm, test, evaluation or {}, conditions, modules, primary) for arm in arms]
    curve_metric = metric or arms[0].best_metric
    known = [name for name in PRIMARY if all(name.removeprefix("-") in values for values in evaluated)]
    shown = {} if not evaluate else {**dataclasses.asdict(conditions), **(evaluation or {})}
    return Comparison(arms, tuple(evaluated), curve_metric, primary or next(iter(known), curve_metric), shown, title)


def _metric_of(arm: Arm, evaluated: Mapping[str, Any], metric: str) -> Any:
    """Return a metric of an arm's evaluation, else the last logged one. Raises InputError: there is none."""
    if metric not in evaluated and not len(arm.last(metric)):
        known = evaluated or arm.members[0].last or ["no metrics in it"]
        raise InputError(f"{arm.name} has no metric {metric}; there are {', '.join(known)}")
    return evaluated.get(metric, arm.last(metric))


def _evaluate(
    arm: Arm, test: TaskCfg, evaluation: Mapping[str, Any], conditions: Conditions, modules: Sequence[ModuleType],
    primary: str,
) -> Values:  # fmt: skip
    """Return the metrics of all seeds of an arm in the evaluation of `jumper evaluate`, without undefined ones.

    test: task of the base, whose commands and terminations all arms of the same kind of task have. Raises InputError
    after the first seed without the metric `primary`, unless it is empty.
    """
    rows = []
    with phase(f"evaluating {arm.name}", len(arm.members)) as advance:
        for member in arm.members:
            run = EvaluationRun(member.folder, modules)
            own = test if run.task.state is test.state else run.task
            try:
                flags = dataclasses.replace(own.evaluation.default_flags("evaluate"), **evaluation)
            except (TypeError, ValueError) as error:
                raise InputError(f"evaluation: {error}") from error
            run.conditions = conditions
            changed = partial(_with_terminations, own)
            log = flags.log(changed(run.task), conditions.stream_seed)
            metrics = flags.metrics(run.run_episodes(run.env(log.count, changed), log))
            rows.append({name: each.value for name, each in metrics.items() if isinstance(each.value, int | float)})
            if primary:
                _metric_of(arm, rows[-1], primary.removeprefix("-"))
            advance()
    names = [name for name in rows[0] if all(name in row for row in rows)]
    return {name: np.array([row[name] for row in rows], dtype=float) for name in names}


def _with_terminations(test: TaskCfg, task: TaskCfg) -> TaskCfg:
    """Return a task as the task `test` is evaluated: all arms must pass the same test."""
    return test.evaluation.prepare_task(dataclasses.replace(task, terminations=test.terminations))
