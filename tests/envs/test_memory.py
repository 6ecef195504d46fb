"""Environments that are dropped free their memory."""

import gc
import weakref

import numpy as np
import torch
import warp as wp

from jump_helpers import make_env

COUNTED = (wp.array, wp.Kernel, wp.Module)


def dropped() -> weakref.ref:
    """Make an environment, step it, drop it, and return a weak reference to it."""
    env = make_env(2)
    env.step(torch.zeros_like(env.action))
    env.evaluation_reset(np.array([[0.5, 0.0, 0.0, 30.0]] * 2))
    return weakref.ref(env)


def live_objects() -> list[int]:
    """Return the number of live objects of each type in `COUNTED`."""
    return [sum(issubclass(type(each), kind) for each in gc.get_objects()) for kind in COUNTED]


def test_dropped_environments_leave_no_arrays_kernels_or_modules():
    env, counts = dropped(), []
    for _ in range(2):
        dropped()
        gc.collect()
        counts.append(live_objects())
    assert env() is None
    assert counts[0] == counts[1] and min(counts[0]) > 0
