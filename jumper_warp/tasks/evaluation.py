"""Evaluation of a task's policies as data: flags of `jumper evaluate` and `play`, and metrics of the task's state."""

from __future__ import annotations

import importlib
from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Any, ClassVar, Literal

import warp as wp

from jumper_warp.tasks.copying import Struct
from jumper_warp.utils.checks import check_types
from jumper_warp.utils.errors import InputError


@dataclass(frozen=True)
class Evaluation:
    """Base class of the evaluations of a task's policies; a field is the default of the flag with the same name."""

    flags: ClassVar[str]
    """Dataclasses of the flags, as `module:Name`: `NameFlags` has those of `jumper evaluate`, `NamePlayFlags` those of
    `jumper play`. The method `log(task, seed)` of the first and `log(task)` of the second return a new `EvaluationLog`,
    which sets the commands of all worlds and records outcomes; `metrics(log)` of the first returns its metrics, and
    `length` of the second is the default length of the recording [s]."""
    published: ClassVar[Mapping[str, float]] = {}
    """Values in the paper of the metrics with the same keys, for the default settings."""

    @property
    def kind(self) -> str:
        """Name of the kind of evaluation, such as height: the class's, in lower case."""
        return type(self).__name__.removesuffix("Evaluation").lower()

    @property
    def paper(self) -> Mapping[str, float]:
        """Values in the paper of the metrics with the same keys; empty for other settings than the default ones."""
        return self.published if self == type(self)() else {}

    def default_flags(self, command: Literal["evaluate", "play"]) -> Any:
        """Return the flags of a command (see `flags`) with their defaults, which a field of the same name replaces."""
        module, _, name = self.flags.partition(":")
        kind = getattr(importlib.import_module(module), f"{name}{'Play' * (command == 'play')}Flags")
        values = vars(self)
        return kind(**{spec.name: values[spec.name] for spec in fields(kind) if spec.name in values})

    def prepare_task(self, task: Any) -> Any:
        """Return a copy of a `TaskCfg` with the terminations and the ground of the evaluation."""
        return task

    def check(self, where: str, state: Struct) -> None:
        """Raise InputError, with `where` before it, unless the evaluation fits the task's `state`, a `@wp.struct`."""


@dataclass(frozen=True)
class EpisodeMetric:
    """Metric of the evaluated episodes: a statistic of a field of the task's state at the end of each episode."""

    key: str  # Name of the metric; ends in the unit, as `place_error_mean_m`
    field: str  # Field of the state, a float or an int
    statistic: Literal["mean", "max", "rate"] = "mean"
    """Statistic over episodes; rate: fraction of the episodes whose field is not 0."""

    def __post_init__(self) -> None:
        """Raise InputError for a text that is none, or another statistic."""
        check_types("metric", self)


@dataclass(frozen=True)
class EpisodeEvaluation(Evaluation):
    """Evaluation of any task by single episodes: their length, termination and base position, and own metrics."""

    metrics: tuple[EpisodeMetric, ...] = ()
    """Metrics of the task's state."""
    goal_marker: str = ""
    """Field of the state that recordings and pictures mark: a place [m], world frame (vec3), or a height of the base
    above z = 0 [m] (float); empty: none."""

    flags: ClassVar = "jumper_warp.evaluation.episodes:Episode"

    def check(self, where: str, state: Struct) -> None:
        """Raise InputError unless the state has the fields of all metrics and of the goal marker."""
        wanted: dict[str, tuple[type, ...]] = {
            metric.field: (float, int, wp.float32, wp.int32) for metric in self.metrics
        }
        wanted |= {self.goal_marker: (float, wp.float32, wp.vec3)} if self.goal_marker else {}
        for field, kinds in wanted.items():
            if field not in state.vars or state.vars[field].type not in kinds:
                types = " or ".join(kind.__name__ for kind in kinds[-2:])
                raise InputError(f"{where} evaluation: the state needs a field {field!r:.60}, {types}")
