"""How much is launched and allocated in a policy step: as little as now, and no more in later steps."""

import contextlib
import dataclasses
from collections import Counter

import pytest
import torch
import warp as wp

import hold_height
from jump_helpers import edit_episodes, make_env, random_actions
from jumper_warp.envs.env import Env
from jumper_warp.kernels.jump.state import LANDED
from jumper_warp.registry import make_task
from jumper_warp.tasks.randomization import RandomizationCfg

N = 4


@contextlib.contextmanager
def counted(monkeypatch):
    """Count Warp's launches, copies, memory that is set, read or written by the host, and allocations, by name."""
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


def eager_counts(env, monkeypatch, steps=30):
    """Return the counts of each of some steps that are launched one by one, with episodes that end in between."""
    found = []
    for step, action in enumerate(random_actions(env.num_envs, steps)):
        env.actions.copy_(action)
        if step % 7 == 3 and env.task.name != "hold-height":
            edit_episodes(env, 0, phase=LANDED, phase_steps=59)
        with counted(monkeypatch) as counts:
            env._launch_step()
        found.append(dict(counts))
    return found


JUMP, HOLD = make_task("vertical-jump"), hold_height.hold_height()
WALKING = dataclasses.replace(JUMP, randomization=RandomizationCfg.walking())
CASES = {
    # action, physics, track, step, 2 to observe; then reset, forget, 2 to observe what has begun
    "nominal": ((JUMP,), {"randomize": False, "noise": False}, 10),
    "measured": ((JUMP,), {"auto_reset": False}, 7),
    # events, in every step too, and packing what they drew
    "randomised": ((JUMP,), {}, 13),
    "pushed": ((WALKING,), {}, 13),
    # of the second skill: events in every step, step, 2 to observe; then home, events, packing, reset, 2 to observe
    "two skills": ((JUMP, HOLD), {}, 23),
}
"""Tasks, settings and number of launches."""


@pytest.mark.parametrize("case", CASES)
def test_a_step_has_so_many_launches_and_no_allocation(case, monkeypatch):
    tasks, arguments, launches = CASES[case]
    env = Env(tasks if len(tasks) > 1 else tasks[0], N, device="cpu", **arguments)
    env.reset()
    env._launch_step()  # loads the modules
    for step, counts in enumerate(eager_counts(env, monkeypatch)):
        assert counts == {"launch": launches}, step


def test_a_captured_step_is_one_launch(monkeypatch):
    env = make_env(N, randomize=True, noise=True)
    env.step(torch.zeros((N, 12)))
    for action in random_actions(N, 20):
        with counted(monkeypatch) as counts:
            env.step(action)
        assert counts == {"capture_launch": 1}


def test_a_step_makes_no_tensor_of_the_environment_anew():
    env = make_env(N, randomize=True, noise=True)

    def places():
        tensors = [env.reward, env.done, env.timeout, env.actions, *env.skills[0].obs.values()]
        arrays = [env.sim.state.joint_q, env.robot.torque, env.parameters.push, env.skills[0].states]
        return [t.data_ptr() for t in tensors] + [array.ptr for array in arrays]

    before = places()
    for action in random_actions(N, 20):
        env.step(action)
    env.reset()
    assert places() == before
