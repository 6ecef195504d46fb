"""Flags of `jumper evaluate` and `play` for the policies of a task, from the task's `Evaluation`."""

from __future__ import annotations

import importlib
from dataclasses import fields
from typing import Any, Literal, Protocol

from jumper_warp.evaluation.log import EvaluationLog
from jumper_warp.registry import TASKS
from jumper_warp.tasks.cfg import TaskCfg
from jumper_warp.tasks.evaluation import EpisodeEvaluation, Evaluation
from jumper_warp.utils.metrics import Metrics


class EvaluationFlags(Protocol):
    """Interface of a dataclass with the flags of `jumper evaluate` for some tasks, such as jumps to heights."""

    def log(self, task: TaskCfg, seed: int) -> EvaluationLog:
        """Return a new evaluation log, which sets all worlds' commands and records outcomes; seed: of the commands."""
        ...

    def metrics(self, log: Any) -> Metrics:
        """Return the metrics of a finished evaluation log that `self.log` returned."""
        ...


class PlayFlags(Protocol):
    """Interface of dataclasses with the flags of `jumper play` for a kind of task, such as jumps or walks."""

    @property
    def length(self) -> float:
        """Default length of the recording [s]."""
        ...

    def log(self, task: TaskCfg) -> EvaluationLog:
        """Return a new evaluation log, which sets the commands of all worlds and records their outcomes."""
        ...


def default_flags(evaluation: Evaluation, command: Literal["evaluate", "play"]) -> Any:
    """Return the default flags of a command for a task, with the values of the evaluation's fields of the same names.

    They are `EvaluationFlags` for `jumper evaluate`, and `PlayFlags` for `jumper play`.
    """
    module, _, name = evaluation.flags.partition(":")
    kind = getattr(importlib.import_module(module), f"{name}{'Play' * (command == 'play')}Flags")
    values = vars(evaluation)
    return kind(**{spec.name: values[spec.name] for spec in fields(kind) if spec.name in values})


def stock_evaluations() -> dict[str, Evaluation]:
    """Return an evaluation of each kind that a stock task has, by `Evaluation.kind`, and that of any task."""
    stock = [entry.task(name).evaluation for name, entry in TASKS.items() if entry.of_project]
    return {each.kind: each for each in (*stock, EpisodeEvaluation())}
