"""`Env.kernels` against the kernels that an environment launches."""

import pytest
import torch
import warp as wp

from jumper_warp.envs.env import Env
from jumper_warp.registry import make_task


@pytest.fixture
def launched(monkeypatch):
    """Return a dict that collects the modules of all launched kernels, with the name of a kernel of each."""
    modules = {}
    launch = wp.launch

    def spy(kernel, *args, **kwargs):
        modules[kernel.module.name] = kernel.key
        return launch(kernel, *args, **kwargs)

    monkeypatch.setattr(wp, "launch", spy)
    return modules


def compiled(env, **options):
    """Return the names of the modules of an environment's kernels; options: of `Env.kernels`."""
    return {kernel.module.name for kernel, _ in env.kernels(**options)}


@pytest.mark.parametrize("task", ["vertical-jump", "velocity-flat"])
def test_kernels_lists_all_modules_that_reset_and_step_launch(task, launched):
    env = Env(make_task(task), 2, seed=1, device="cpu")
    launched.clear()
    env.reset()
    env.step(torch.zeros(2, 12))
    assert len(launched) >= 8
    assert set(launched) - compiled(env) <= {
        "jumper_warp.kernels.dynamics.parameters",
        "jumper_warp.kernels.dynamics.restore",
    }


def test_an_evaluation_does_not_compile_the_sampling_of_starts(launched):
    env = Env(make_task("vertical-jump"), 2, seed=1, device="cpu")
    launched.clear()
    env.evaluation_reset([0.0, 0.0, 0.7])
    env.step(torch.zeros(2, 12))
    reset = env.skills[0].kernels["reset"].module.name
    assert reset not in launched and reset not in compiled(env, draws=False)
    assert set(launched) - compiled(env, draws=False) <= {"jumper_warp.kernels.dynamics.parameters"}
