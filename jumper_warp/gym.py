"""Registration of the tasks with Gymnasium at import: vertical-jump becomes `jumper_warp/VerticalJump-v0`."""

from __future__ import annotations

from typing import Any

import gymnasium

from jumper_warp.envs.env import Env
from jumper_warp.envs.gymnasium import GymEnv, GymVectorEnv
from jumper_warp.registry import TASKS, make_task
from jumper_warp.robot.overlay import robots_of
from jumper_warp.tasks.cfg import TaskCfg

ADAPTER = ("all_groups", "tensors", "autoreset_mode", "render_mode", "render_size", "render_envs")
"""Arguments of `GymVectorEnv`."""


def _task(name: str, arguments: dict[str, Any]) -> TaskCfg:
    """Return the task of a name for the robot among an environment's arguments, the first of several."""
    return make_task(name, next(iter(robots_of(arguments.get("robot"))), None))


def make_vector_env(task: str, num_envs: int = 1, **arguments: Any) -> GymVectorEnv:
    """Return a Gymnasium vector environment of a task with `num_envs` robots.

    arguments: keyword arguments of `Env`, and those of `GymVectorEnv` that are in `ADAPTER`.
    Raises InputError: an unknown task, or arguments that `Env` or `GymVectorEnv` refuses.
    """
    adapter = {name: arguments.pop(name) for name in ADAPTER if name in arguments}
    return GymVectorEnv(Env(_task(task, arguments), num_envs, **arguments), **adapter)


def make_env(task: str, **arguments: Any) -> GymEnv:
    """Return a Gymnasium environment of a task with one robot; arguments: keyword arguments of `GymEnv` and `Env`.

    Raises InputError: an unknown task, or arguments that `Env` or `GymEnv` refuses.
    """
    adapter = {name: arguments.pop(name) for name in ADAPTER if name in arguments}
    return GymEnv(Env(_task(task, arguments), 1, **arguments), **adapter)


def env_id(task: str) -> str:
    """Return Gymnasium's id of a task, `jumper_warp/VerticalJump-v0` for vertical-jump."""
    return f"jumper_warp/{''.join(word.capitalize() for word in task.split('-'))}-v0"


def register_envs() -> None:
    """Register every task in `TASKS` that Gymnasium does not have yet."""
    for task in TASKS:
        if env_id(task) not in gymnasium.registry:
            gymnasium.register(
                env_id(task),
                "jumper_warp.gym:make_env",
                vector_entry_point="jumper_warp.gym:make_vector_env",
                kwargs={"task": task},
            )


register_envs()
