"""Warm starts of trainings from trained policies, whose observation and joints must agree with the task's."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from itertools import zip_longest
from pathlib import Path
from typing import Any

from jumper_warp.envs.vec_env import RAW_LIMIT
from jumper_warp.policies.policy import Policy
from jumper_warp.policies.spec import PolicyInterface
from jumper_warp.rl.actor_init import ActorInit, make_actor_init
from jumper_warp.rl.cfg import PpoCfg
from jumper_warp.rl.mirror import Symmetries, make_symmetries
from jumper_warp.rl.networks import NORMALISED_LIMIT
from jumper_warp.robot.description import RobotDescription
from jumper_warp.tasks.cfg import TaskCfg
from jumper_warp.tasks.interface import interface
from jumper_warp.tasks.mirror import mirror_image
from jumper_warp.utils.errors import InputError
from jumper_warp.utils.files import Json


def actor_init_from_policy(
    source: str | Path, task: TaskCfg, cfg: PpoCfg, robot: RobotDescription | None = None
) -> ActorInit:
    """Return the initialisation of a training's actor from the policy `source` (see `Policy.load`).

    robot: of the training, by default the Jumper.
    Observation and joints must agree; action scale, gains, torque limits and time steps may differ.
    Raises PolicyError or CheckpointError: there is no such policy, or it cannot be used. Raises InputError: its
    observation or joints differ from the task's, or an error of `make_actor_init`.
    """
    policy = Policy.load(source)
    check_interface(policy.interface, interface(task, robot))
    symmetries = task_symmetries(task, cfg.symmetry)
    return make_actor_init(policy.layers, policy.mean, policy.std, policy.interface.activation, cfg, symmetries)


def task_symmetries(task: TaskCfg, symmetry: str) -> Symmetries:
    """Return the mirror maps of a task's actor observation and action; symmetry: as in `PpoCfg`.

    Raises InputError: a mirror image is not known.
    """
    return make_symmetries(symmetry, partial(mirror_image, task))


def check_interface(policy: PolicyInterface, task: Json) -> None:
    """Raise InputError with the first difference, if a policy and a task differ in observation or joints.

    task: its description by `jumper_warp.tasks.interface`.
    """
    for quantity, policy_value, task_value in _compared_values(policy, task):
        if policy_value != task_value:
            raise InputError(f"init_policy: {quantity}: the policy has {policy_value}, the task {task_value}")


def _compared_values(policy: PolicyInterface, task: Json) -> Iterator[tuple[str, Any, Any]]:
    """Yield the quantities that must agree between policy and task, as (name, policy's value, task's value).

    With another order, scale or default angle the network would get or command other quantities than it has learned.
    """
    for label, field in (("observation", "observation_names"), ("action", "joint_names")):
        for column, names in enumerate(zip_longest(getattr(policy, field), task[field], fillvalue="none")):
            yield f"{label} {column}", names[0], names[1]
    for name, term in policy.observation_layout.items():  # empty if unknown
        for key, value in term.items():
            yield f"{key} of {name}", value, task["observation_layout"].get(name, {}).get(key, "none")
    angles = zip(policy.joint_names, policy.default_joint_pos, task["default_joint_pos"], strict=True)
    for joint, angle, task_angle in angles:
        yield f"default angle [rad] of {joint}", round(angle, 6), round(task_angle, 6)
    yield "limit of observations", policy.observation_limit, RAW_LIMIT
    yield "limit of observations in standard deviations", policy.normalised_limit, NORMALISED_LIMIT
