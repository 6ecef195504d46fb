"""Numbers of launches, copies and allocations in a policy step, which are the same in every step."""

from collections import Counter

import torch
import warp as wp

from jump_helpers import make_env, random_actions

N = 4


def test_a_captured_step_is_one_launch(monkeypatch):
    env, counts = make_env(N, randomize=True, noise=True), Counter()
    env.step(torch.zeros((N, 12)))
    allocator = type(wp.get_device("cpu").get_allocator())
    calls = [(wp, "launch"), (wp, "copy"), (wp, "capture_launch"), (allocator, "allocate")]
    for owner, name in calls + [(wp.array, name) for name in ("zero_", "fill_", "assign", "numpy")]:
        original = getattr(owner, name)

        def counted(*args, name=name, original=original, **settings):
            counts[name] += 1
            return original(*args, **settings)

        monkeypatch.setattr(owner, name, counted)
    for action in random_actions(N, 20):
        env.step(action)
    assert counts == {"capture_launch": 20}
