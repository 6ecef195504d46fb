"""Numbers of launches, copies and allocations in a policy step, which are the same in every step."""

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


def eager_counts(env, monkeypatch, steps=30):
    """Return the counts of each of `steps` uncaptured steps, some of which end an episode."""
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
    # action, physics, track, step, 2 observations; then reset, clear history, 2 observations of new episodes
    "nominal": ((JUMP,), {"randomize": False, "noise": False}, 10),
    "measured": ((JUMP,), {"auto_reset": False}, 7),
    # also events after the reset and in every step, and packing of the sampled parameters
    "randomised": ((JUMP,), {}, 13),
    "pushed": ((WALKING,), {}, 13),
    # second skill: events in every step, step, 2 observations; then home, events, packing, reset, 2 observations
    "two skills": ((JUMP, HOLD), {}, 23),
}
"""Tasks, settings and number of launches by name of the case."""


@pytest.mark.parametrize("case", CASES)
def test_a_step_has_the_expected_launches_and_no_allocation(case, monkeypatch):
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


def test_steps_and_resets_reuse_the_environments_arrays():
    env = make_env(N, randomize=True, noise=True)

    def addresses():
        tensors = [env.reward, env.done, env.timeout, env.actions, *env.skills[0].obs.values()]
        arrays = [env.sim.state.joint_q, env.robot.torque, env.parameters.push, env.skills[0].states]
        return [t.data_ptr() for t in tensors] + [array.ptr for array in arrays]

    before = addresses()
    for action in random_actions(N, 20):
        env.step(action)
    env.reset()
    assert addresses() == before
