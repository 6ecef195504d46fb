"""The task that a policy's or a run's configuration saved.

Configurations are data: functions are looked up in the project's modules and in those that the user has named.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable
from types import ModuleType
from typing import Any

from jumper_warp.policies.spec import PolicyError
from jumper_warp.tasks.cfg import TaskCfg
from jumper_warp.tasks.saving import OPTIONAL, TaskError, task_from_json


def restored_task(
    config: dict[str, Any], modules: Iterable[ModuleType] = (), *, leave_out: Collection[str] = OPTIONAL
) -> TaskCfg:
    """Return the task of a saved configuration, from its entry `env` (`Env.config`).

    config: what a policy or a run was made with. modules: that the user has named; functions that are not the project's
    are looked up there. leave_out: sections that are not wanted, and whose functions need not be found; by default all
    that only a training needs.
    Raises PolicyError: the configuration is not of a task that is known here.
    """
    try:
        saved = config["env"]["task"]
    except (KeyError, TypeError) as error:
        raise PolicyError(f"no task in the configuration ({type(error).__name__}: {error})") from error
    try:
        return task_from_json(saved, modules, leave_out=leave_out)
    except TaskError as error:
        raise PolicyError(f"task in the configuration: {error}") from error
