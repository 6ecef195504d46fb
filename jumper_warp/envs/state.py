"""Save and restore the complete state of an environment, so that later steps are bitwise the same."""

from __future__ import annotations

import hashlib
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
import warp as wp

from jumper_warp.kernels.mdp.env import Counters, Delays, EpisodeArrays
from jumper_warp.kernels.mdp.parameters import RobotParameters
from jumper_warp.kernels.mdp.view import RobotArrays
from jumper_warp.utils.checks import check_type
from jumper_warp.utils.errors import InputError
from jumper_warp.utils.kernels import records
from jumper_warp.utils.streams import purpose_seed

if TYPE_CHECKING:
    from jumper_warp.envs.stages import Stages

CONSTANT = ("gravity", "default_angle", "paw_shapes", "listed", "num_listed")
"""Arrays of the kernels' structs that are not saved: constant, like those named `nominal_*`, or set in each step."""
MOTORS = ("kp", "kd", "saturation", "peak", "no_load_speed", "cutoff_speed", "offset")
"""Names of the saved arrays of the simulation's motors."""
FINGERPRINT = "nominal"  # Key of the nominal parameters' fingerprint
SEED = "seed"  # Key of the seed (`purpose_seed`)


def save_state(env: Stages) -> dict[str, torch.Tensor]:
    """Return the complete state of an environment as CPU tensors by name (waits for the device).

    Keys: "struct.field" of the kernels' arrays, "task/name" and "task.field" of each task, `nominal`, `seed`,
    `ends_episodes` and "condition.name" of options. Nominal parameters are saved as a fingerprint only, numbers of
    terms only if `Env.set` changed them.
    """
    state = {name: tensor.to("cpu", copy=True) for name, tensor in _tensors(env).items()}
    for prefix, array in _records(env).items():
        fields = records(array)
        state |= {prefix + name: torch.from_numpy(np.array(fields[name])) for name in fields.dtype.names or ()}
    state |= {FINGERPRINT: nominal_fingerprint(env), SEED: torch.tensor(purpose_seed(env.stream, env.seed))}
    state["ends_episodes"] = torch.tensor(env._ends_episodes)
    return state | _conditions(env)


def load_state(env: Stages, state: dict[str, torch.Tensor]) -> None:
    """Restore the arrays of a saved state of an environment, and the terms' numbers that `Env.set` had changed.

    Values that are not finite are restored too: without `auto_reset` a diverged world keeps them.
    Raises InputError (a ValueError), and changes nothing: another num_envs, task, solver, robot, seed, randomize,
    noise, refine or version.
    """
    check_type("state", state, dict)
    for name, value in state.items():
        check_type(f"saved {name!s:.60}", value, torch.Tensor)
    own = save_state(env)
    if own.keys() != state.keys():
        raise InputError(
            f"saved by another version, task or solver: lacks {sorted(own.keys() - state.keys())[:5]}, "
            f"has unknown {sorted(state.keys() - own.keys())[:5]}"
        )
    if (saved_envs := len(state["env.done"])) != env.num_envs:
        raise InputError(f"saved with num_envs {saved_envs}, this environment has {env.num_envs}")
    for name, value in _conditions(env).items():
        if not torch.equal(state[name], value):
            option = name.partition(".")[2]
            raise InputError(f"saved with {option} {state[name].item()}, this environment has {option} {value.item()}")
    for name, value in own.items():
        if (state[name].shape, state[name].dtype) != (value.shape, value.dtype):
            raise InputError(f"saved {name} has another shape or type")
    for skill in env.skills:
        skill.params.restored(state[f"{skill.task.name}/changed"].numpy())
    if not torch.equal(state[FINGERPRINT], own[FINGERPRINT]):
        raise InputError("saved with other robots: the description or the task's motors differ")
    if not torch.equal(state[SEED], own[SEED]):
        raise InputError(f"saved with seed {int(state[SEED])}, this environment has seed {int(own[SEED])}")
    for prefix, array in _records(env).items():
        fields = records(array).copy()
        for name in fields.dtype.names or ():
            fields[name] = state[prefix + name].numpy()
        array.assign(wp.array(fields, dtype=array.dtype, device=env.wp_device))
    for name, tensor in _tensors(env).items():
        tensor.copy_(state[name])
    env._ends_episodes = bool(state["ends_episodes"])
    for skill in env.skills:
        skill.params.restore()


def _conditions(env: Stages) -> dict[str, torch.Tensor]:
    """Return the options of an environment that a saved state depends on, by key, as tensors without dimensions."""
    randomize, noise = env.conditions
    options = {"randomize": randomize, "noise": noise, "substeps": env.sim.substeps}
    return {f"condition.{name}": torch.tensor(value) for name, value in options.items()}


def nominal_fingerprint(env: Stages) -> torch.Tensor:
    """Return the SHA-256 of all nominal robot parameters, (32,) uint8; it does not depend on the device."""
    digest = hashlib.sha256()
    for name in RobotParameters.vars:
        if name.startswith("nominal_"):
            digest.update(getattr(env.parameters, name).numpy().tobytes())
    return torch.frombuffer(bytearray(digest.digest()), dtype=torch.uint8)


def _records(env: Stages) -> dict[str, wp.array]:
    """Return an environment's arrays of structs (task states, any blocks) that are saved, by prefix of their keys."""
    blocks = env.sim.dynamics.robot.ground.blocks
    states = {f"{skill.task.name}.": skill.states for skill in env.skills}
    return states | ({"block.": blocks} if blocks.shape[0] else {})


def _tensors(env: Stages) -> dict[str, torch.Tensor]:
    """Return torch views of the environment's saved arrays, except arrays of structs, by key."""
    arrays: dict[str, Any] = {}
    structs = (("robot", RobotArrays, env.robot), ("env", EpisodeArrays, env.episodes), ("delays", Delays, env.delays),
               ("parameters", RobotParameters, env.parameters))  # fmt: skip
    for prefix, kind, struct in structs:
        for name in kind.vars:
            if name not in CONSTANT and not name.startswith("nominal_"):
                arrays[f"{prefix}.{name}"] = getattr(struct, name)
    arrays |= {f"motors.{name}": getattr(env.sim.motors, name) for name in MOTORS}
    arrays |= {f"solver.{name}": array for name, array in env.sim.dynamics.carried().items()}
    for skill in env.skills:
        arrays |= {f"{skill.task.name}/{name}": getattr(skill.observations, name) for name in ("now", "final", "past")}
        own = {"timer": skill.timer, "changed": skill.params.changed, "episode_sum": skill.episode_sum}
        arrays |= {f"{skill.task.name}/{name}": array for name, array in own.items()}
        arrays |= {f"{skill.task.name}/counters.{name}": getattr(skill.counters, name) for name in Counters.vars}
    return {name: wp.to_torch(array) for name, array in arrays.items() if isinstance(array, wp.array)}
