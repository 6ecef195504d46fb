"""Environments that are dropped free their memory."""

import gc

import numpy as np
import torch
import warp as wp

from jump_helpers import make_env

COUNTED = (wp.array, wp.Kernel, wp.Module)


def live_objects() -> list[int]:
    """Return the number of live objects of each type in `COUNTED`."""
    return [sum(issubclass(type(each), kind) for each in gc.get_objects()) for kind in COUNTED]


def test_dropped_environments_leave_no_arrays_kernels_or_modules():
    counts = []
    for _ in range(2):
        env = make_env(2)
        env.step(torch.zeros_like(env.action))
        env.evaluation_reset(np.array([[0.5, 0.0, 0.0, 30.0]] * 2))
        del env
        gc.collect()
        counts.append(live_objects())
    assert counts[0] == counts[1] and min(counts[0]) > 0
