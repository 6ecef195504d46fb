"""The arrays that the stages of a policy step share, and checks of what comes from outside."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
import torch
import warp as wp

from jumper_warp.kernels.mdp.env import RING, Delays, EpisodeArrays, Scene
from jumper_warp.kernels.mdp.view import RobotArrays
from jumper_warp.robot.description import load_description
from jumper_warp.sim.simulation import Simulation
from jumper_warp.tasks.cfg import Handover, TaskCfg
from jumper_warp.tasks.commands import check_commands
from jumper_warp.utils.errors import InputError

FIRST_STEP_COUNT = 2 * RING
"""Of every world, so that rings can look back from the first step on."""


def fill(struct: Any, names: Iterable[str], shape: int | tuple[int, ...], kind: Any, device: Any) -> None:
    """Give members of a kernels' struct arrays of zeros of their own."""
    for name in names:
        setattr(struct, name, wp.zeros(shape, dtype=kind, device=device))


def robot_arrays(sim: Simulation, step_dt: float) -> Any:
    """Return the kernels' `RobotArrays` on a simulation's memory; step_dt [s]: policy step."""
    n, device, robot = sim.num_worlds, sim.device, RobotArrays()
    robot.joint_q, robot.joint_qd, robot.body_f = sim.state.joint_q, sim.state.joint_qd, sim.state.body_f
    robot.body_com, robot.gravity = sim.model.body_com, sim.model.gravity
    robot.diverged, robot.impulse = sim.physics.diverged, sim.physics.impulse
    robot.paw_force, robot.peak_force = sim.paw_force, sim.physics.peak_paw_force
    robot.torque, robot.joint_offset = sim.torque, sim.motors.offset
    motors = ("prev_torque", "action", "prev_action", "prev_prev_action", "target", "filtered_target", "prev_rate")
    fill(robot, ("paw_pos", "paw_vel"), (4, n), wp.vec3, device)
    fill(robot, ("contact_time", "air_time", "touchdown_speed", "paw_height"), (4, n), float, device)
    fill(robot, ("collisions",), (4, n), int, device)
    fill(robot, motors, (12, n), float, device)
    fill(robot, ("prev_lin_vel",), n, wp.vec3, device)
    robot.default_angle = wp.array(load_description().pose("default"), dtype=float, device=device)
    robot.step_dt = step_dt
    return robot


def episode_arrays(num_envs: int, seed: int, skill: wp.array, device: Any) -> Any:
    """Return the kernels' `EpisodeArrays`."""
    episode = EpisodeArrays()
    episode.seed, episode.skill = seed, skill
    counts = (
        "requested_task",
        "has_command",
        "history_reset",
        "termination",
        "diverged",
        "bad_action",
        "level",
        "streak",
    )
    fill(episode, ("pending_command",), num_envs, wp.vec4, device)
    fill(episode, counts, num_envs, int, device)
    fill(episode, ("reward", "done", "timeout"), num_envs, float, device)
    fill(episode, ("terminated", "truncated"), num_envs, wp.bool, device)
    episode.step_count = wp.full(num_envs, FIRST_STEP_COUNT, dtype=int, device=device)
    episode.requested_task.fill_(-1)
    return episode


def delay_arrays(num_envs: int, latency: wp.array, substeps: int, device: Any) -> Any:
    """Return the kernels' `Delays`; latency [physics steps]: (num_envs,)."""
    delays = Delays()
    fill(delays, ("target_history",), (RING, 12, num_envs), float, device)
    fill(delays, ("current_target", "prev_target"), (12, num_envs), float, device)
    fill(delays, ("switch_step",), num_envs, int, device)
    delays.steps, delays.substeps = latency, substeps
    return delays


def scene_of(sim: Simulation) -> Any:
    """Return the kernels' `Scene`."""
    scene, robot = Scene(), sim.physics.dynamics.robot
    scene.geometry, scene.ground, scene.reference_q = robot.geometry, robot.ground, sim.model.joint_q
    return scene


def checked_tasks(task: Any, handovers: Sequence[Handover]) -> tuple[TaskCfg, ...]:
    """Return the tasks of an environment, given as one or several.

    Raises ValueError: not a task, none, two of one name, motors that cannot be those of one robot, different
    gravities, or a handover between others.
    """
    several = isinstance(task, Iterable) and not isinstance(task, str)
    tasks: tuple[Any, ...] = tuple(task) if several else (task,)
    for each in tasks:
        if not isinstance(each, TaskCfg):
            raise InputError(f"a task must be a TaskCfg, as make_task returns for a name, got {each!r:.60}")
    names = [each.name for each in tasks]
    if not tasks or len(set(names)) < len(names):
        raise InputError(f"an environment needs at least one task, each with a name of its own, got {names}")
    first = tasks[0].motors
    for each in tasks[1:]:
        limits, its = (
            (motors.fade_start, motors.fade_end, motors.lateral.peak, motors.transversal.peak)
            for motors in (first, each.motors)
        )
        if its != limits:
            raise InputError(f"{each.name} needs the peak torque and the over-speed protection of {names[0]}'s motors")
        if each.gravity != tasks[0].gravity:
            raise InputError(f"{each.name} has a gravity of {each.gravity} m/s^2, {names[0]} of {tasks[0].gravity}")
    for each in handovers:
        if each.source not in tasks or each.target not in tasks:
            raise InputError(f"a handover needs two of the tasks {names}, got {each.source.name} to {each.target.name}")
    return tasks


def prepared(
    tasks: Sequence[TaskCfg], randomize: bool, noise: bool, ground_may_vary: bool
) -> tuple[tuple[TaskCfg, ...], bool]:
    """Return the tasks as an environment runs them, and whether their grounds are drawn."""
    found, draws = [], False
    for task in tasks:
        if not (randomize and ground_may_vary):
            task = task.on_level_ground()
        draws = draws or task.draws_ground
        task = task if randomize else task.nominal()
        found.append(task if noise else task.without_noise())
    return tuple(found), draws


def checked_action(action: Any, shape: tuple[int, ...], device: torch.device) -> torch.Tensor:
    """Return an action without its gradient. Raises ValueError for another shape, kind of numbers or device."""
    if not isinstance(action, torch.Tensor):
        raise InputError(f"an action must be a torch tensor, got {type(action).__name__}")
    if tuple(action.shape) != shape:
        raise InputError(f"an action must have shape {shape}, got {tuple(action.shape)}")
    if not action.is_floating_point():
        raise InputError(f"an action must hold floating-point numbers, got {action.dtype}")
    if action.device != device:
        raise InputError(f"an action must be on {device}, got {action.device}")
    return action.detach()


def on_host(values: Any) -> Any:
    """Return a tensor as an array, and anything else unchanged."""
    return values.detach().cpu().numpy() if isinstance(values, torch.Tensor) else values


def as_numbers(values: Any, what: str) -> np.ndarray:
    """Return values as float32. Raises ValueError: not numbers, or lists of different lengths."""
    values = on_host(values)
    try:
        return np.asarray(values, dtype=np.float32)
    except (ValueError, TypeError) as error:
        raise InputError(f"{what} must be an array of numbers, got {type(values).__name__}: {error}") from error


def checked_values(values: Any, shape: tuple[int, ...], what: str) -> np.ndarray:
    """Return values as float32, one for all or of a shape. Raises ValueError: another shape, or not finite."""
    array = as_numbers(values, what)
    if array.ndim and array.shape != shape:
        raise InputError(f"{what} must have shape {shape}, got {array.shape}")
    if not np.isfinite(array).all():
        raise InputError(f"{what} must be finite")
    return np.ascontiguousarray(np.broadcast_to(array, shape))


def checked_skill(skill: Any, num_envs: int, num_skills: int) -> np.ndarray:
    """Return each world's index of a task as int32, given for all or one by one. Raises ValueError for another."""
    array = np.asarray(skill)
    if array.shape not in ((), (num_envs,)) or array.dtype.kind not in "iu":
        raise InputError(f"skill must be an index or {num_envs} whole ones, got {array.dtype} of shape {array.shape}")
    if not ((array >= 0) & (array < num_skills)).all():
        raise InputError(f"skill must be an index below {num_skills}, got {array.min()} to {array.max()}")
    return np.ascontiguousarray(np.broadcast_to(array.astype(np.int32), num_envs))


def checked_mask(worlds: Any, num_envs: int) -> np.ndarray:
    """Return which worlds are meant as float32 ones and zeros, all for None. Raises ValueError for another shape."""
    if worlds is None:
        return np.ones(num_envs, dtype=np.float32)
    array = np.asarray(on_host(worlds))
    if array.shape != (num_envs,) or array.dtype != bool:
        raise InputError(f"worlds must be bool of shape ({num_envs},), got {array.dtype} of shape {array.shape}")
    return array.astype(np.float32)


def checked_worlds(worlds: Any, num_envs: int) -> np.ndarray:
    """Return the mask of worlds, given as bool or as indices. Raises ValueError: neither, twice the same or none."""
    array = np.asarray(on_host(worlds))
    if array.dtype.kind not in "iu":
        return checked_mask(array, num_envs)
    fits = array.ndim == 1 and bool(((array >= 0) & (array < num_envs)).all())
    if not fits or len(np.unique(array)) < len(array):
        raise InputError(f"worlds must be {num_envs} bools, or different indices below {num_envs}, got {worlds!r:.60}")
    mask = np.zeros(num_envs, dtype=np.float32)
    mask[array] = 1.0
    return mask


def checked_commands(commands: Any, mask: np.ndarray, tasks: Sequence[TaskCfg]) -> np.ndarray:
    """Return commands as (num_envs, 4), for worlds with mask not 0, which are on one of the tasks.

    Raises ValueError: not what the command of any of these tasks takes.
    """
    array, n, refusals = as_numbers(commands, "commands"), len(mask), []
    for task in tasks:
        try:
            check_commands(array, task, n, mask > 0.0)
        except InputError as error:
            refusals.append(error)
    if len(refusals) == len(tasks):
        raise refusals[0]
    filled = np.pad(np.atleast_2d(array), ((0, 0), (0, 4 - array.shape[-1])))
    return np.ascontiguousarray(np.broadcast_to(filled, (n, 4)))
