"""Environments of velocity tracking, and functions that read and edit states of their worlds."""

import numpy as np

from jumper_warp.envs.env import Env
from jumper_warp.kernels.velocity.state import VelocityState
from jumper_warp.registry import make_task

FIELDS = tuple(VelocityState.vars)


def walking_env(num_envs: int, name: str = "velocity-flat", task=None, **arguments) -> Env:
    """Return a reset environment on the CPU, by default nominal and without noise."""
    settings = {"seed": 1, "randomize": False, "noise": False} | arguments
    env = Env(make_task(name) if task is None else task, num_envs, device="cpu", **settings)
    env.reset()
    return env


def states_of(env: Env) -> dict[str, np.ndarray]:
    """Return copies of all fields of the worlds' states."""
    records = env.skills[0].states.numpy()
    return {name: records[name].copy() for name in FIELDS}


def edit(env: Env, worlds=slice(None), **fields) -> None:
    """Overwrite fields of the states of an environment's first task."""
    states = env.skills[0].states
    records = states.numpy().copy()
    for name, value in fields.items():
        records[name][worlds] = value
    states.assign(records)
