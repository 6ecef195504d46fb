"""Restoring of the task in a saved configuration of a policy or a run.

Configurations are data: functions are looked up in the project's modules and in the modules that the user names.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable
from types import ModuleType
from typing import TYPE_CHECKING, Any

from jumper_warp.policies.spec import PolicyError
from jumper_warp.tasks.cfg import TaskCfg
from jumper_warp.tasks.saving import OPTIONAL, TaskError, task_from_json

if TYPE_CHECKING:
    from jumper_warp.policies.policy import Policy


def task_of_policy(
    policy: Policy, modules: Iterable[ModuleType] = (), *, leave_out: Collection[str] = OPTIONAL
) -> TaskCfg:
    """Return the task that a policy was trained on, from its saved configuration.

    Arguments and errors: see `restored_task`.
    Raises PolicyError also if the task's observation differs from the policy's.
    """
    task = restored_task(policy.config, modules, leave_out=leave_out)
    if task.observation_names != policy.interface.observation_names:
        raise PolicyError("the policy's observation differs from that of its task in this version")
    return task


def restored_task(
    config: dict[str, Any], modules: Iterable[ModuleType] = (), *, leave_out: Collection[str] = OPTIONAL
) -> TaskCfg:
    """Restore the task in a saved configuration of a policy or a training run, from its entry `env.task`.

    config: configuration of a policy or a run. modules: user modules in which functions from outside the project are
    looked up. leave_out: sections to leave empty (default: the sections that only a training needs).
    Raises PolicyError: the configuration has no task, or it cannot be restored.
    """
    try:
        return task_from_json(config["env"]["task"], modules, leave_out=leave_out)
    except TaskError as error:
        raise PolicyError(f"task in the configuration: {error}") from error
    except (KeyError, TypeError) as error:
        raise PolicyError(f"no task in the configuration ({type(error).__name__}: {error})") from error
