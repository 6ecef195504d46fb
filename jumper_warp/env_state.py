"""What the next step of an environment depends on, as tensors: taken, and put back, bit for bit."""

from __future__ import annotations

import hashlib
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
import warp as wp

from jumper_warp.solver import SolverJumper
from jumper_warp.state_checks import check_tensor, check_values
from kernels.task import ViewArrays

if TYPE_CHECKING:
    from jumper_warp.env import JumpEnv

RESULTS = ("obs", "final_obs", "critic_obs", "final_critic_obs", "reward", "done", "timeout")
"""What `JumpEnv.step` leaves behind, as far as an environment has it."""
CONSTANT_VIEWS = ("body_com", "default_angle")
"""Arrays of `ViewArrays` that are no state."""
DRAWN = ("body_mass", "body_com", "body_inertia", "joint_armature", "joint_friction", "shape_material_mu")
DRAWN_MOTORS = ("kp", "kd", "saturation", "peak", "no_load_speed", "cutoff_speed", "offset")
DRAWN_OUTSIDE = ("push", "delay", "joint_offset", "static_friction_ratio")
"""Parameters of the model, its motors and the environment that the seed decides."""
MUJOCO = ("qacc_warmstart", "cvel", "cdof_dot")
"""What SolverMuJoCo carries from step to step beside Newton's state."""
EPISODE, BLOCK = "episode.", "block."
"""Before the name of a field of `JumpTask` and of `Block`."""
FINGERPRINT = "parameters"
"""Name of the drawn parameters' fingerprint."""


def save_state(env: JumpEnv) -> dict[str, torch.Tensor]:
    """Return everything that the next step depends on, on the CPU (waits for the device); counters are left out.

    The world is the last axis of Warp's arrays and the first of observations and episodes. Drawn parameters are not
    in it, only their fingerprint: the seed draws them anew.
    """
    state = {name: tensor.to("cpu", copy=True) for name, tensor in _tensors(env).items()}
    for prefix, array in _records(env).items():
        records = array.numpy()
        state |= {prefix + name: torch.from_numpy(np.array(records[name])) for name in records.dtype.names}
    return state | {FINGERPRINT: parameter_fingerprint(env)}


def load_state(env: JumpEnv, state: dict[str, torch.Tensor]) -> None:
    """Put a saved state back, so that the next step is the one that would have followed.

    Raises:
        ValueError: It is of another number of environments, other fields or other robots, or a field is no tensor or
            of another shape or type; nothing is changed.
    """
    if not isinstance(state, dict):
        raise ValueError(f"a saved environment must be a dictionary, got {type(state).__name__}")
    tensors, records = _tensors(env), {prefix: array.numpy().copy() for prefix, array in _records(env).items()}
    fields = {prefix + name: (prefix, name) for prefix, values in records.items() for name in values.dtype.names}
    names = {*tensors, *fields, FINGERPRINT}
    if names != state.keys():
        raise ValueError(
            f"saved by another version or solver: lacks {sorted(names - state.keys())}, "
            f"has {sorted(state.keys() - names)} besides"
        )
    done = state["done"]
    if isinstance(done, torch.Tensor) and done.dim() == 1 and len(done) != env.num_envs:
        raise ValueError(f"saved for {len(done)} environments, there are {env.num_envs}")
    for name, tensor in tensors.items():
        check_tensor(state[name], tensor, f"saved {name}")
    for field, (prefix, name) in fields.items():
        check_tensor(state[field], torch.from_numpy(records[prefix][name].copy()), f"saved {field}")
    check_values(state[EPISODE + "level"], f"saved {EPISODE}level", 0)  # indexes the curriculum
    check_tensor(state[FINGERPRINT], parameter_fingerprint(env), f"saved {FINGERPRINT}")
    if not torch.equal(state[FINGERPRINT], parameter_fingerprint(env)):
        raise ValueError("saved with other robots: seed, description or randomisation differ")
    for field, (prefix, name) in fields.items():
        records[prefix][name] = state[field].numpy()
    for prefix, array in _records(env).items():
        array.assign(wp.array(records[prefix], dtype=array.dtype, device=env.wp_device))
    for name, tensor in tensors.items():
        tensor.copy_(state[name])


def parameter_fingerprint(env: JumpEnv) -> torch.Tensor:
    """Return the SHA-256 (32 bytes) of all drawn parameters; it does not depend on the device."""
    digest = hashlib.sha256()
    for owner, names in ((env.sim.model, DRAWN), (env.sim.motors, DRAWN_MOTORS), (env, DRAWN_OUTSIDE)):
        for name in names:
            digest.update(getattr(owner, name).numpy().tobytes())
    return torch.frombuffer(bytearray(digest.digest()), dtype=torch.uint8)


def _records(env: JumpEnv) -> dict[str, wp.array]:
    """Return the environment's arrays of structs by the prefix of their fields; blocks only where there are any."""
    blocks = env._dynamics.robot.ground.blocks
    return {EPISODE: env.tasks} | ({BLOCK: blocks} if blocks.shape[0] else {})


def _tensors(env: JumpEnv) -> dict[str, torch.Tensor]:
    """Return views of the environment's own memory by name."""
    arrays: dict[str, Any] = {name: getattr(env._views, name) for name in ViewArrays.vars if name not in CONSTANT_VIEWS}
    arrays |= {"previous_target": env._previous_target, "impulse": env._impulse, "invalid": env._invalid}
    arrays["random"] = env._random
    if not isinstance(env.sim.solver, SolverJumper):
        arrays |= {"body_q": env.sim.state.body_q, "body_qd": env.sim.state.body_qd}
        arrays |= {name: getattr(env.sim.solver.mjw_data, name) for name in MUJOCO}
    tensors = {name: wp.to_torch(array) for name, array in arrays.items() if isinstance(array, wp.array)}
    return tensors | {name: getattr(env, name) for name in RESULTS if hasattr(env, name)}
