"""The settings of the run that `jumper train --resume` goes on with."""

from __future__ import annotations

import dataclasses
import json
import sys
from types import ModuleType
from typing import TYPE_CHECKING, Any

from jumper_warp.policies.restore import restored_task
from jumper_warp.rl.checkpoint import DAMAGE, CheckpointError, one_line
from jumper_warp.rl.resume import SESSION, find_checkpoint
from jumper_warp.robot.overlay import RobotOverlay
from jumper_warp.tasks.saving import TaskError, check_version

if TYPE_CHECKING:
    from pathlib import Path

    from jumper_warp.cli.train import TrainArgs
    from jumper_warp.rl.cfg import TrainCfg
    from jumper_warp.tasks.cfg import TaskCfg


def loaded_modules() -> list[ModuleType]:
    """Return all modules that are imported by now; a task that was made has its functions in these."""
    return [module for module in sys.modules.values() if isinstance(module, ModuleType)]


def with_run(default: TrainArgs, cfg: TrainCfg) -> tuple[TrainArgs, TaskCfg]:
    """Return the settings of the run that `cfg.resume` names, and its task.

    default: For what the run does not tell, and for what is of the session, see SESSION.

    Raises:
        InputError: There is no such run, it is of another task or version, or its settings cannot be used.
    """
    path, saved = saved_config(cfg)
    try:
        env, train = saved["env"], {name: v for name, v in saved["train"].items() if name not in SESSION}
        args = dataclasses.replace(
            default,
            cfg=with_saved(default.cfg, train),
            solver="mujoco" if env.get("solver") == "SolverMuJoCo" else "jumper",
            randomize=env.get("randomize", default.randomize),
            noise=env.get("noise", default.noise),
            robot_of_run=RobotOverlay.from_json(env["robot"]) if "robot" in env else None,
        )
        return args, restored_task(saved, loaded_modules(), leave_out=())
    except DAMAGE as error:
        raise CheckpointError(f"{path}: settings in its configuration: {one_line(error)}") from error


def saved_config(cfg: TrainCfg) -> tuple[Path, dict[str, Any]]:
    """Return the checkpoint that is resumed and its configuration.

    Raises:
        CheckpointError: There is none, or it is of another task or version.
    """
    path, state, _ = find_checkpoint(cfg)
    try:
        saved = json.loads(state["config"])
        name = saved["train"]["task"]
        check_version(saved["env"]["task"])
    except TaskError as error:
        raise CheckpointError(f"{path}: {error}") from error
    except (KeyError, TypeError, ValueError) as error:
        raise CheckpointError(f"{path}: no task in its configuration ({type(error).__name__}: {error})") from error
    if name != cfg.task:
        raise CheckpointError(f"{path}: of a run of {name!s:.60}, not of {cfg.task}")
    return path, saved


def with_saved(settings: Any, saved: dict[str, Any]) -> Any:
    """Return a dataclass of settings with those that were saved. Raises ValueError or TypeError: one cannot be used."""
    new = {}
    for name, own in vars(settings).items():
        if name in saved:
            value = saved[name]
            value = with_saved(own, value) if dataclasses.is_dataclass(own) else value
            new[name] = tuple(value) if isinstance(value, list) else value
    return dataclasses.replace(settings, **new)
