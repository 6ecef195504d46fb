"""Warm start of a training from a policy: checks of its interface, and initialisation of the actor."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import zip_longest
from pathlib import Path
from typing import Any

from jumper_warp.envs.vec_env import RAW_LIMIT
from jumper_warp.policies.runs import open_policy
from jumper_warp.policies.spec import PolicyInterface
from jumper_warp.rl.actor_init import ActorInit, make_actor_init
from jumper_warp.rl.cfg import PpoCfg
from jumper_warp.rl.mirror import Symmetry, mirror_map
from jumper_warp.rl.networks import NORMALISED_LIMIT
from jumper_warp.tasks.cfg import TaskCfg
from jumper_warp.tasks.interface import interface
from jumper_warp.tasks.mirror import mirror_of, mirror_of_action
from jumper_warp.utils.errors import InputError


def actor_init_from_policy(source: str | Path, task: TaskCfg, cfg: PpoCfg) -> ActorInit:
    """Return the initialisation of a training's actor from the policy `source` (see `open_policy`).

    Observation and joints must agree; action scale, gains, torque limits and time steps may differ.
    Raises PolicyError or CheckpointError: there is no such policy, or it cannot be used. Raises InputError: its
    observation or joints differ from the task's, or an error of `make_actor_init`.
    """
    policy = open_policy(source)
    check_interface(policy.interface, interface(task))
    symmetry = task_symmetry(task) if cfg.symmetry == "actor" else None
    return make_actor_init(policy.layers, policy.mean, policy.std, policy.interface.activation, cfg, symmetry)


def task_symmetry(task: TaskCfg) -> Symmetry:
    """Return the left-right mirror maps of a task's actor observation and action."""
    return Symmetry(mirror_map(*mirror_of(task, "actor"), "observation"), mirror_map(*mirror_of_action(), "action"))


def check_interface(policy: PolicyInterface, task: dict[str, Any]) -> None:
    """Raise InputError with the first difference, if a policy and a task differ in observation or joints.

    task: its description by `jumper_warp.tasks.interface`.
    """
    for quantity, policy_value, task_value in _compared_values(policy, task):
        if policy_value != task_value:
            raise InputError(f"init_policy: {quantity}: the policy has {policy_value}, the task {task_value}")


def _compared_values(policy: PolicyInterface, task: dict[str, Any]) -> Iterator[tuple[str, Any, Any]]:
    """Yield the quantities that must agree between policy and task, as (name, policy's value, task's value)."""
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
