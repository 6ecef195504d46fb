"""Numbers of launches, copies and allocations in a policy step, which are the same in every step."""

import contextlib
from collections import Counter

import torch
import warp as wp

from jump_helpers import make_env, random_actions

N = 4


@contextlib.contextmanager
def counted(monkeypatch):
    """Count Warp's launches, copies, host accesses to arrays (set, read, write) and allocations, by name."""
    counts = Counter()

    def counting(name, original):
        def call(*args, **kwargs):
            counts[name] += 1
            return original(*args, **kwargs)

        return call

    with monkeypatch.context() as patch:
        for name in ("launch", "copy", "capture_launch"):
            patch.setattr(wp, name, counting(name, getattr(wp, name)))
        for name in ("zero_", "fill_", "assign", "numpy"):
            patch.setattr(wp.array, name, counting(name, getattr(wp.array, name)))
        allocator = type(wp.get_device("cpu").get_allocator())
        patch.setattr(allocator, "allocate", counting("allocate", allocator.allocate))
        yield counts


def test_a_captured_step_is_one_launch(monkeypatch):
    env = make_env(N, randomize=True, noise=True)
    env.step(torch.zeros((N, 12)))
    for action in random_actions(N, 20):
        with counted(monkeypatch) as counts:
            env.step(action)
        assert counts == {"capture_launch": 1}
