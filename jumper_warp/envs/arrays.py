"""Allocation of an environment's kernel arrays, and checks of arguments such as actions and commands."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np
import torch
import warp as wp

from jumper_warp.kernels.mdp.env import RING, Delays, EpisodeArrays, Scene
from jumper_warp.kernels.mdp.view import RobotArrays
from jumper_warp.sim.simulation import Simulation
from jumper_warp.tasks.cfg import TaskCfg
from jumper_warp.utils.arrays import real_array
from jumper_warp.utils.errors import InputError
from jumper_warp.utils.kernels import KernelStruct
from jumper_warp.utils.streams import PURPOSES, Purpose

FIRST_STEP_COUNT = 2 * RING
"""Step count of every world at the start; ring buffers need a positive index for earlier steps."""


def allocate(
    struct: KernelStruct, names: Iterable[str], shape: int | tuple[int, ...], dtype: type, device: wp.DeviceLike
) -> None:
    """Set each named member of a kernel struct to a new array of zeros."""
    for name in names:
        setattr(struct, name, wp.zeros(shape, dtype=dtype, device=device))


def robot_arrays(sim: Simulation, step_dt: float) -> KernelStruct:
    """Return the kernels' `RobotArrays`: views of a simulation's state and forces, and new arrays for paws and motors.

    step_dt [s]: policy step.
    """
    n = sim.num_worlds
    device = sim.device
    robot = RobotArrays()
    for name in ("joint_q", "joint_qd", "body_f"):
        setattr(robot, name, getattr(sim.state, name))
    robot.body_com = sim.model.body_com
    robot.gravity = sim.model.gravity
    robot.diverged = sim.dynamics.work.diverged
    robot.impulse = sim.dynamics.work.impulse
    robot.paw_force = sim.paw_force
    robot.peak_force = sim.peak_paw_force
    robot.torque = sim.torque
    robot.joint_offset = sim.motors.offset
    motors = ("prev_torque", "action", "prev_action", "prev_prev_action", "target", "filtered_target", "prev_rate")
    allocate(robot, ("paw_pos", "paw_vel"), (4, n), wp.vec3, device)
    allocate(robot, ("contact_time", "air_time", "touchdown_speed", "paw_height"), (4, n), float, device)
    allocate(robot, ("collisions",), (4, n), int, device)
    allocate(robot, motors, (12, n), float, device)
    allocate(robot, ("prev_lin_vel",), n, wp.vec3, device)
    robot.default_angle = wp.array(sim.descriptions[0].pose("default"), dtype=float, device=device)
    robot.step_dt = step_dt
    return robot


def episode_arrays(num_envs: int, seed: int, stream: Purpose, skill: wp.array, device: wp.DeviceLike) -> KernelStruct:
    """Return new arrays of every world's episode state (`EpisodeArrays`), ready for the first reset.

    seed, stream: random seed, and the purpose whose random numbers it selects; skill: (num_envs,) index of each world's
    task. A requested task or termination of -1 means none.
    """
    episode = EpisodeArrays()
    episode.seed = seed
    episode.purpose = PURPOSES.index(stream)
    episode.skill = skill
    counts = ("requested_task", "has_command", "history_reset", "termination", "diverged", "bad_action", "level",
              "streak", "listed", "num_listed")  # fmt: skip
    allocate(episode, ("pending_command",), num_envs, wp.vec4, device)
    allocate(episode, counts, num_envs, int, device)
    allocate(episode, ("reward", "done", "timeout"), num_envs, float, device)
    allocate(episode, ("terminated", "truncated"), num_envs, wp.bool, device)
    episode.step_count = wp.full(num_envs, FIRST_STEP_COUNT, dtype=int, device=device)
    for array in (episode.requested_task, episode.termination):
        array.fill_(-1)
    return episode


def delay_arrays(num_envs: int, latency: wp.array, substeps: int, device: wp.DeviceLike) -> KernelStruct:
    """Return the ring buffers that delay motor targets in the kernels (`Delays`).

    latency: (num_envs,) int [physics steps]; substeps: physics steps in a policy step.
    """
    delays = Delays()
    allocate(delays, ("target_history",), (RING, 12, num_envs), float, device)
    allocate(delays, ("current_target", "prev_target"), (12, num_envs), float, device)
    allocate(delays, ("switch_step",), num_envs, int, device)
    delays.steps = latency
    delays.substeps = substeps
    return delays


def scene_of(sim: Simulation) -> KernelStruct:
    """Return the kernels' `Scene` (ground and robot constants) of a simulation."""
    scene = Scene()
    robot = sim.dynamics.robot
    scene.geometry = robot.geometry
    scene.ground = robot.ground
    scene.reference_q = sim.model.joint_q
    return scene


def checked_action(action: object, shape: tuple[int, ...], device: torch.device) -> torch.Tensor:
    """Check type, shape and device of a policy action, and return it without gradient.

    Raises InputError: no floating-point tensor of this shape and device.
    """
    if not isinstance(action, torch.Tensor):
        raise InputError(f"an action must be a torch tensor, got {type(action).__name__}")
    if tuple(action.shape) != shape:
        raise InputError(f"an action must have shape {shape}, got {tuple(action.shape)}")
    if not action.is_floating_point():
        raise InputError(f"an action must hold floating-point numbers, got {action.dtype}")
    if action.device != device:
        raise InputError(f"an action must be on {device}, got {action.device}")
    return action.detach()


def to_numpy(values: object) -> object:
    """Return a torch tensor as a NumPy array, and anything else unchanged."""
    return values.detach().cpu().numpy() if isinstance(values, torch.Tensor) else values


def checked_values(values: object, shape: tuple[int, ...], name: str) -> np.ndarray:
    """Return a scalar or array as float32 array of `shape`. Raises InputError: other shape, or not finite."""
    array = real_array(values, name)
    if array.ndim and array.shape != shape:
        raise InputError(f"{name} must have shape {shape}, got {array.shape}")
    if not np.isfinite(array).all():
        raise InputError(f"{name} must be finite")
    return np.ascontiguousarray(np.broadcast_to(array, shape))


def checked_skill(skill: object, num_envs: int, num_skills: int) -> np.ndarray:
    """Check task indices, and return one for each world, (num_envs,) int32.

    skill: one index for all worlds, or (num_envs,). Raises InputError: not integers from 0 to num_skills - 1.
    """
    array = np.asarray(skill)
    if array.shape not in ((), (num_envs,)) or array.dtype.kind not in "iu":
        raise InputError(f"skill must be one int or {num_envs} ints, got {array.dtype} of shape {array.shape}")
    if not ((array >= 0) & (array < num_skills)).all():
        raise InputError(f"skill must be an index below {num_skills}, got {array.min()} to {array.max()}")
    return np.ascontiguousarray(np.broadcast_to(array.astype(np.int32), num_envs))


def checked_mask(worlds: object, num_envs: int) -> np.ndarray:
    """Convert a bool mask of worlds, (num_envs,) or None for all, to a float32 mask, 1 in selected worlds.

    Raises InputError: another shape or type.
    """
    if worlds is None:
        return np.ones(num_envs, dtype=np.float32)
    array = np.asarray(to_numpy(worlds))
    if array.shape != (num_envs,) or array.dtype != bool:
        raise InputError(f"worlds must be bool of shape ({num_envs},), got {array.dtype} of shape {array.shape}")
    return array.astype(np.float32)


def checked_worlds(worlds: object, num_envs: int) -> np.ndarray:
    """Convert a bool mask, (num_envs,), or distinct indices of worlds to a float32 mask, 1 in selected worlds.

    Raises InputError: neither of them.
    """
    array = np.asarray(to_numpy(worlds))
    if array.dtype.kind not in "iu":
        return checked_mask(array, num_envs)
    fits = array.ndim == 1 and bool(((array >= 0) & (array < num_envs)).all())
    if not fits or len(np.unique(array)) < len(array):
        raise InputError(f"worlds must be {num_envs} bools, or distinct indices below {num_envs}, got {worlds!r:.60}")
    mask = np.zeros(num_envs, dtype=np.float32)
    mask[array] = 1.0
    return mask


def checked_commands(commands: object, mask: np.ndarray, tasks: Sequence[TaskCfg]) -> np.ndarray:
    """Check that commands are valid for a task, and return them as float32 (num_envs, 4), padded with zeros.

    mask: (num_envs,), nonzero for worlds to command; bounds are checked only there.
    commands: integers or floating-point numbers, (n,) for all worlds or (num_envs, n), valid for at least one task:
    which one a world has is known only on the device. n is 1 to 4, since kernels read the values as a `wp.vec4`.
    tasks: at least one. Raises InputError: not an array of real numbers, or the first task's error if commands are
    valid for none.
    """
    array = real_array(commands, "commands")
    n = len(mask)
    errors = []
    for task in tasks:
        try:
            task.command.check(array, task.name, mask > 0.0)
        except InputError as error:
            errors.append(error)
    if len(errors) == len(tasks):
        raise errors[0]
    filled = np.pad(np.atleast_2d(array), ((0, 0), (0, 4 - array.shape[-1])))
    return np.ascontiguousarray(np.broadcast_to(filled, (n, 4)))
