"""Gymnasium's names of the tasks: importing this registers them, `jumper_warp/VerticalJump-v0` for vertical-jump."""

from __future__ import annotations

from typing import Any, NoReturn

import gymnasium

from jumper_warp.envs.env import Env
from jumper_warp.envs.gymnasium import GymVectorEnv
from jumper_warp.registry import TASKS, make_task
from jumper_warp.utils.errors import InputError


def make_vector_env(
    task: str, num_envs: int = 1, *, all_groups: bool = False, tensors: bool = False, **arguments: Any
) -> GymVectorEnv:
    """Return a vector of environments; arguments: of `Env`; others: of `GymVectorEnv`.

    Raises InputError: an unknown task, or as these.
    """
    return GymVectorEnv(Env(make_task(task), num_envs, **arguments), all_groups=all_groups, tensors=tensors)


def refuse_single_env(task: str, **arguments: Any) -> NoReturn:
    """Stand where `gymnasium.make` looks. Raises InputError, which names what there is instead."""
    raise InputError(f"robots come as a vector: gymnasium.make_vec({env_id(task)!r}, num_envs=1), not gymnasium.make")


def env_id(task: str) -> str:
    """Return Gymnasium's name of a task."""
    return f"jumper_warp/{''.join(word.capitalize() for word in task.split('-'))}-v0"


def register_envs() -> None:
    """Register the tasks that are not yet registered."""
    for task in TASKS:
        if env_id(task) not in gymnasium.registry:
            gymnasium.register(
                env_id(task),
                "jumper_warp.gym:refuse_single_env",
                vector_entry_point="jumper_warp.gym:make_vector_env",
                kwargs={"task": task},
            )


register_envs()
