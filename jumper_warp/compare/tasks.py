"""Tasks of a user's file, and the task of the project that such a task changes."""

from __future__ import annotations

from pathlib import Path

from jumper_warp.compare.arms import differences
from jumper_warp.registry import TASKS, load_task_module, make_task
from jumper_warp.rl.run_folder import flat_settings
from jumper_warp.tasks.cfg import TaskCfg
from jumper_warp.tasks.saving import task_to_json
from jumper_warp.utils.errors import InputError


def task_of(source: str) -> TaskCfg:
    """Return the task of a name, of FILE.py, which must register one task, or of FILE.py:TASK.

    Raises InputError: there is no such task, or the file registers several.
    """
    file, colon, name = source.partition(".py:")
    if not colon and not source.endswith(".py"):
        return make_task(source)
    path = Path(file + ".py" if colon else source)
    load_task_module(str(path))
    own = [task for task, entry in TASKS.items() if entry.origin == path.stem]
    if not colon and len(own) != 1:
        raise InputError(f"{path} registers {', '.join(own) or 'no task'}: name one as {path}:TASK")
    return make_task(name or own[0])


def base_of(task: TaskCfg) -> str:
    """Return the name of the project's task with the same state that differs from a task in the fewest settings.

    Raises InputError: none has the same state.
    """
    others = {name: entry.task(name) for name, entry in TASKS.items() if entry.of_project and name != task.name}
    same = {name: other for name, other in others.items() if other.state is task.state}
    if not same:
        raise InputError(f"{task.name} has a state of its own: name the task to compare with by --base TASK")
    return min(same, key=lambda name: len(differences([_settings(task), _settings(same[name])])))


def _settings(task: TaskCfg) -> dict:
    """Return the settings of a task by flag name."""
    return flat_settings({"train": {}, "env": {"task": task_to_json(task)}})
