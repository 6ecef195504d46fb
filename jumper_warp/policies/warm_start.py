"""Beginning a training with a policy: whether it reads and drives what the task does, and its actor."""

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
    """Return what a training of a task begins with to act as a policy does; source: as `open_policy` takes it.

    Scales of actions, gains, torques, times and all that the environment does may be others than the policy's own.

    Raises PolicyError or CheckpointError: there is no such policy, or it cannot be used. Raises InputError: its
    observation or its joints are not the task's, or as `make_actor_init`.
    """
    policy = open_policy(source)
    check_interface(policy.interface, interface(task))
    symmetry = None
    if cfg.symmetry == "actor":
        obs, action = mirror_of(task, "policy"), mirror_of_action()
        symmetry = Symmetry(mirror_map(*obs, "observation"), mirror_map(*action, "action"))
    return make_actor_init(policy.layers, policy.mean, policy.std, policy.interface.activation, cfg, symmetry)


def check_interface(face: PolicyInterface, described: dict[str, Any]) -> None:
    """Raise InputError that names the first difference between what a policy and a task read and drive.

    described: what `jumper_warp.tasks.interface` says of the task.
    """
    for what, own, other in _compared(face, described):
        if own != other:
            raise InputError(f"start_from: {what}: the policy has {own}, the task {other}")


def _compared(face: PolicyInterface, described: dict[str, Any]) -> Iterator[tuple[str, Any, Any]]:
    """Yield what has to agree, of the policy and of the task."""
    for what, name in (("observation", "observation_names"), ("action", "joint_names")):
        for column, pair in enumerate(zip_longest(getattr(face, name), described[name], fillvalue="none")):
            yield f"{what} {column}", pair[0], pair[1]
    layout = described["observation_layout"]
    for name, term in face.observation_layout.items():  # none if they are not known
        for key, own in term.items():
            yield f"{key} of {name}", own, layout.get(name, {}).get(key, "none")
    angles = zip(face.joint_names, face.default_joint_pos, described["default_joint_pos"], strict=True)
    for joint, own, other in angles:
        yield f"default angle [rad] of {joint}", round(own, 6), round(other, 6)
    yield "limit of observations", face.observation_limit, RAW_LIMIT
    yield "limit of observations in standard deviations", face.normalised_limit, NORMALISED_LIMIT
