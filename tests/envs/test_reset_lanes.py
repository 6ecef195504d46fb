"""Reset with several threads per world (for GPUs) against one thread per world, both on the CPU."""

import numpy as np
import pytest
import warp as wp

from ground_helpers import hardest
from jumper_warp.envs.env import Env
from jumper_warp.kernels.mdp.attempts import LANES
from jumper_warp.registry import make_task

N = 96


def reset_by(env, lanes):
    """Return coordinates, rates and states of the worlds after a reset with `lanes` threads per world."""
    skill = env.skills[0]
    env.sim.state.joint_q.assign(np.tile(env.sim.model.joint_q.numpy()[:43], N))
    skill.states.zero_()
    inputs = [skill.index, lanes, env._all, env._scene, env._settings, skill.settings, skill.levels, env.episodes,
              skill.states, env.robot]  # fmt: skip
    wp.launch(skill.kernels["reset"], (N, lanes), inputs, device="cpu", block_dim=max(lanes, 1))
    return env.sim.joint_q(), env.sim.joint_qd(), skill.states.numpy().copy()


@pytest.mark.parametrize("name", ["velocity-rough", "horizontal-jump", "attitude"])
def test_several_threads_per_world_sample_the_same_starts_as_one(name, monkeypatch):
    env = Env(hardest(make_task(name)), N, seed=3, device="cpu", randomize=False, noise=False)
    env.reset()
    alone = reset_by(env, 1)
    monkeypatch.setattr(wp.config, "enable_cpu_blocks", True)
    shared = reset_by(env, LANES)
    for found, expected in zip(shared[:2], alone[:2], strict=True):
        np.testing.assert_array_equal(found, expected)
    for field in shared[2].dtype.names:
        np.testing.assert_array_equal(shared[2][field], alone[2][field], err_msg=field)
    default = env.sim.model.joint_q.numpy()[7:43]
    assert (alone[0][:, 7:] != default).any(axis=1).sum() > N // 2  # sampled, not the default pose
