"""The tasks and handovers that a policy's or a run's configuration saved.

Configurations are data: functions are looked up in the project's modules and in those that the user has named.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable
from types import ModuleType
from typing import Any

from jumper_warp.policies.spec import PolicyError
from jumper_warp.tasks.cfg import Handover, TaskCfg
from jumper_warp.tasks.saving import OPTIONAL, TaskError, handover_from_json, task_from_json


def restored_task(
    config: dict[str, Any], modules: Iterable[ModuleType] = (), *, leave_out: Collection[str] = OPTIONAL
) -> TaskCfg:
    """Return the task of a saved configuration, from its entry `env` (`Env.config`).

    Args:
        config: What a policy or a run was made with.
        modules: That the user has named; functions that are not the project's are looked up there.
        leave_out: Sections that are not wanted, and whose functions need not be found; by default all that only a
            training needs.

    Raises:
        PolicyError: The configuration is not of a task that is known here.
    """
    try:
        saved = config["env"]["task"]
    except (KeyError, TypeError) as error:
        raise PolicyError(f"no task in the configuration ({type(error).__name__}: {error})") from error
    try:
        return task_from_json(saved, modules, leave_out=leave_out)
    except TaskError as error:
        raise PolicyError(f"task in the configuration: {error}") from error


def restored_skills(config: dict[str, Any], modules: Iterable[ModuleType] = ()) -> tuple[list[TaskCfg], list[Handover]]:
    """Return all tasks and handovers of an environment's saved configuration (`Env.config`).

    modules: that the user has named. Raises PolicyError: it is not of tasks and functions that are known here.
    """
    modules = list(modules)
    try:
        tasks = [task_from_json(saved, modules) for saved in config.get("tasks", [config["task"]])]
        return tasks, [handover_from_json(saved, tasks, modules) for saved in config.get("handovers", [])]
    except TaskError as error:
        raise PolicyError(f"tasks in the configuration: {error}") from error
    except (LookupError, TypeError, AttributeError) as error:
        raise PolicyError(f"no tasks in the configuration ({type(error).__name__}: {error})") from error
