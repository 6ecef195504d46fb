"""Read the settings of a training run that `jumper train --resume` continues."""

from __future__ import annotations

import dataclasses
import sys
from types import ModuleType
from typing import TYPE_CHECKING, Any

from jumper_warp.policies.restore import restored_task
from jumper_warp.rl.checkpoint import DECODE_ERRORS, CheckpointError, one_line_message
from jumper_warp.rl.resume import SESSION
from jumper_warp.robot.overlay import RobotOverlay
from jumper_warp.tasks.saving import TaskError, check_version
from jumper_warp.utils.files import parse_json

if TYPE_CHECKING:
    from jumper_warp.rl.cfg import TrainCfg
    from jumper_warp.rl.checkpoint import Checkpoint
    from jumper_warp.tasks.cfg import TaskCfg


def loaded_modules() -> list[ModuleType]:
    """Return all imported modules, which include the modules of every registered task's functions."""
    return [module for module in sys.modules.values() if isinstance(module, ModuleType)]


def settings_of_run(checkpoint: Checkpoint, cfg: TrainCfg) -> tuple[dict[str, Any], TaskCfg]:
    """Return the settings of a checkpoint's run, by field of `jumper_warp.cli.train.TrainArgs`, and its task.

    cfg: task and defaults, for settings that the run lacks and settings in SESSION.
    Raises CheckpointError: the run is of another task or version, or its settings cannot be used.
    """
    saved = _config(checkpoint, cfg.task)
    try:
        env, train = saved["env"], {name: v for name, v in saved["train"].items() if name not in SESSION}
        settings = {name: env[name] for name in ("randomize", "noise") if name in env}
        settings |= {"cfg": with_saved_settings(cfg, train), "checkpoint": checkpoint}
        settings["solver"] = "mujoco" if env.get("solver") == "SolverMuJoCo" else "jumper"
        settings["overlay"] = RobotOverlay.from_json(env["robot"]) if "robot" in env else None
        return settings, restored_task(saved, loaded_modules(), leave_out=())
    except DECODE_ERRORS as error:
        raise CheckpointError(f"{checkpoint.path}: settings in its configuration: {one_line_message(error)}") from error


def _config(checkpoint: Checkpoint, task: str) -> dict[str, Any]:
    """Return the configuration that a training run saved in a checkpoint.

    Raises CheckpointError: it has another task name or version, or none.
    """
    path = checkpoint.path
    try:
        saved = parse_json(checkpoint.state["config"], "config")
        name = saved["train"]["task"]
        check_version(saved["env"]["task"])
    except TaskError as error:
        raise CheckpointError(f"{path}: {error}") from error
    except (KeyError, TypeError, ValueError) as error:
        raise CheckpointError(f"{path}: no task in its configuration ({type(error).__name__}: {error})") from error
    if name != task:
        raise CheckpointError(f"{path}: of a run of {name!s:.60}, not of {task}")
    return saved


def with_saved_settings(settings: Any, saved: dict[str, Any]) -> Any:
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
