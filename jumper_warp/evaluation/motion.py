"""Complete states of recorded robots, from which the terms of any task can be evaluated once more."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np
import warp as wp

from jumper_warp.kernels.mdp.view import RobotArrays
from jumper_warp.utils.kernels import records

if TYPE_CHECKING:
    from jumper_warp.envs.env import Env

PER_WORLD = ("joint_q", "joint_qd", "body_com", "gravity", "diverged", "prev_lin_vel")
"""Names of the arrays of `RobotArrays` whose first axis runs over worlds; other arrays have worlds on the second."""
SKIPPED = ("body_f", "impulse", "default_angle", "step_dt")
"""Members of `RobotArrays` that terms do not read, or constant."""
ROBOT, STATE, TERMINATION = "robot.", "state.", "termination"  # Begins of the keys, and key of the termination's index
ROBOT_STATES = tuple(ROBOT + name for name in RobotArrays.vars if name not in SKIPPED)  # Keys of the robot's arrays


def robot_state(env: Env, worlds: Sequence[int]) -> dict[str, np.ndarray]:
    """Return the arrays of `RobotView`, and the termination's index (-1: none), of some worlds, (worlds, ...) each."""
    state = {TERMINATION: env.episodes.termination.numpy()[list(worlds)].copy()}
    for key in ROBOT_STATES:
        name = key.removeprefix(ROBOT)
        state[key] = _by_world(name, getattr(env.robot, name).numpy(), env.num_envs)[list(worlds)].copy()
    return state


def task_state(env: Env, worlds: Sequence[int]) -> dict[str, np.ndarray]:
    """Return the fields of the first task's state of some worlds, (worlds, ...) each; it holds the command."""
    state = records(env.skills[0].states)
    return {STATE + name: np.array(state[name])[list(worlds)] for name in state.dtype.names or ()}


def set_motion(env: Env, motion: Mapping[str, np.ndarray], frame: int) -> None:
    """Set the robots of an environment to a recorded frame, and its task states to those before that policy step.

    motion: see `Recording.motion`; fields that the task's state does not share with it keep their values.
    """
    for key, values in motion.items():
        if key.startswith(ROBOT):
            array = getattr(env.robot, name := key.removeprefix(ROBOT))
            host = array.numpy()
            _by_world(name, host, env.num_envs)[: env.num_envs] = values[frame]
            array.assign(host)
    states = records(env.skills[0].states).copy()
    for name in states.dtype.names or ():
        recorded = motion.get(STATE + name)
        if recorded is not None and recorded.shape[1:] == states[name].shape:
            states[name] = recorded[frame]
    env.skills[0].states.assign(wp.array(states, dtype=env.task.state, device=env.wp_device))


def _by_world(name: str, values: np.ndarray, num_envs: int) -> np.ndarray:
    """Return a view of an array of `RobotArrays` with worlds on the first axis."""
    if name not in PER_WORLD:
        return values.swapaxes(0, 1)
    return values if len(values) <= num_envs + 1 else values.reshape(num_envs, -1, *values.shape[1:])
