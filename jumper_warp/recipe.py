"""Recipe of a training: task, simulated robots, and settings of the trainer.

The configuration in a run's folder, in its checkpoints and in a policy's folder (`config.json`) holds the recipe, with
the commit, versions and device of the training.
"""

from __future__ import annotations

import dataclasses
import json
import sys
from collections.abc import Iterable
from dataclasses import dataclass, field
from types import ModuleType
from typing import Any, Literal

from jumper_warp.registry import find_task
from jumper_warp.rl.cfg import SESSION, TrainCfg
from jumper_warp.robot.overlay import RobotOverlay
from jumper_warp.tasks.cfg import TaskCfg
from jumper_warp.tasks.saving import OPTIONAL, TaskError, task_from_json, task_to_json
from jumper_warp.utils.checks import check_types
from jumper_warp.utils.errors import InputError
from jumper_warp.utils.files import Json

SOLVERS = {"SolverJumper": "jumper", "SolverMuJoCo": "mujoco"}  # Setting `solver` by class name of the solver


@dataclass(frozen=True)
class Recipe:
    """Task, simulated robots and trainer settings of a training; `jumper_warp.training.train` trains from it."""

    task: TaskCfg
    train: TrainCfg = field(default_factory=TrainCfg)
    solver: Literal["jumper", "mujoco"] = "jumper"
    randomize: bool = True  # Whether masses, friction, motors, latency and pushes are sampled
    noise: bool = True  # Whether observations have noise
    robot: RobotOverlay | None = None  # Values that replace the robot description's
    missing: str = ""  # Reason why the task lacks its events, whose functions were not found; empty: it has them

    def __post_init__(self) -> None:
        """Name the task in the trainer's settings. Raises InputError: a field is of another type."""
        check_types("recipe", self)
        object.__setattr__(self, "train", dataclasses.replace(self.train, task=self.task.name))

    @classmethod
    def of(cls, name: str, robot: RobotOverlay | None = None) -> Recipe:
        """Return the default recipe of a task by name or alias, of the Jumper or of another robot (`load_overlay`).

        Raises InputError: there is no such task.
        """
        name, entry = find_task(name)
        return cls(entry.task(name, robot), entry.training(name), robot=robot)

    @classmethod
    def from_json(
        cls, config: Json, modules: Iterable[ModuleType] | None = None, *, defaults: TrainCfg | None = None,
        complete: bool = True,
    ) -> Recipe:  # fmt: skip
        """Restore the recipe in the configuration of a run, checkpoint or policy.

        modules: the user's, in which functions from outside the project are looked up (default: all imported ones).
        defaults: settings of the trainer that the configuration lacks, and those that belong to a session. complete:
        whether the task's rewards, events and critic must be found; else sections in OPTIONAL may stay empty.
        Raises TaskError: the task or another setting cannot be restored.
        """
        try:
            env, train = config["env"], config.get("train", {})
            task, missing = _restored(env["task"], _imported() if modules is None else list(modules), complete)
            given = {name: env[name] for name in ("randomize", "noise") if name in env}
            given["solver"] = SOLVERS[env.get("solver", "SolverJumper")]
            given["robot"] = RobotOverlay.from_json(env["robot"]) if env.get("robot") else None
            kept = {name: value for name, value in train.items() if name not in SESSION}
            return cls(task, with_saved_settings(defaults or TrainCfg(), kept), missing=missing, **given)
        except TaskError:
            raise
        except (LookupError, TypeError, ValueError, AttributeError) as error:
            kind = "" if isinstance(error, InputError) else f"{type(error).__name__}: "
            raise TaskError(f"settings in its configuration: {kind}{error!s:.200}") from error

    def to_json(self) -> Json:
        """Return the recipe as JSON data. Raises TaskError: a part of the task cannot be saved."""
        env: Json = {name: getattr(self, name) for name in ("randomize", "noise")}
        env |= {"task": task_to_json(self.task), "solver": next(k for k, v in SOLVERS.items() if v == self.solver)}
        env |= {} if self.robot is None else {"robot": self.robot.to_json()}
        # as read from a file, so that recipes can be compared: paths become texts, tuples become lists
        return {"train": json.loads(json.dumps(dataclasses.asdict(self.train), default=str)), "env": env}

    def check_saving(self) -> None:
        """Raise TaskError unless the task, saved as JSON and read back, is unchanged.

        It is called before a training, whose checkpoints would otherwise stand for another task.
        """
        task = self.task
        if task_from_json(json.loads(json.dumps(task_to_json(task))), _imported()) != task:
            raise TaskError(f"{task.name} differs from the original after it is saved as JSON and loaded")


def _imported() -> list[ModuleType]:
    """Return all imported modules, which include those of every registered task's functions."""
    return [module for module in sys.modules.values() if isinstance(module, ModuleType)]


def _restored(saved: Any, modules: list[ModuleType], complete: bool) -> tuple[TaskCfg, str]:
    """Return the task in JSON data, and the reason why it lacks its events; arguments: see `Recipe.from_json`.

    Functions of a user's task may be missing. Unless it must be `complete`, rewards and critic may then be left out: a
    trained policy does not need them. If that is not enough, all sections in OPTIONAL are left out.
    """
    try:
        return task_from_json(saved, modules), ""
    except TaskError:
        if complete:
            raise
    try:
        return task_from_json(saved, modules, leave_out=("rewards", "critic")), ""
    except TaskError as error:
        return task_from_json(saved, modules, leave_out=OPTIONAL), str(error)


def with_saved_settings(settings: Any, saved: Json) -> Any:
    """Return a copy of a dataclass with the values in `saved`, by field, nested dicts for nested dataclasses.

    Lists become tuples. Raises ValueError or TypeError: a value is invalid.
    """
    new = {}
    for name, default in vars(settings).items():
        if name in saved:
            value = saved[name]
            value = with_saved_settings(default, value) if dataclasses.is_dataclass(default) else value
            new[name] = tuple(value) if isinstance(value, list) else value
    return dataclasses.replace(settings, **new)
