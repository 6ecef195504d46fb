"""Flags of `jumper evaluate` and `play` for the policies of a task, from the task's `Evaluation`."""

from __future__ import annotations

import importlib
from dataclasses import fields
from typing import Any, Literal

from jumper_warp.tasks.evaluation import Evaluation


def default_flags(evaluation: Evaluation, command: Literal["evaluate", "play"]) -> Any:
    """Return the default flags of a command for a task, with the values of the evaluation's fields of the same names.

    `Evaluation.flags` has their methods.
    """
    module, _, name = evaluation.flags.partition(":")
    kind = getattr(importlib.import_module(module), f"{name}{'Play' * (command == 'play')}Flags")
    values = vars(evaluation)
    return kind(**{spec.name: values[spec.name] for spec in fields(kind) if spec.name in values})
