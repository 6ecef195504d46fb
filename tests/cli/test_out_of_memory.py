"""Exhausted memory: one line with the number of worlds and flags to lower, exit code 1, and the run resumes."""

import pytest
import torch

from cli_helpers import run
from jumper_warp.envs.env import Env
from jumper_warp.rl.torch.ppo import Ppo

ARGS = ["vertical-jump", "--device", "cpu", "--no-tensorboard", "--num-envs", "8", "--max-iterations", "3",
        "--save-interval", "1", "--ppo.num-steps", "2", "--ppo.minibatches", "2", "--ppo.hidden", "8"]  # fmt: skip
ERRORS = [
    torch.OutOfMemoryError("CUDA out of memory. Tried to allocate 2.00 GiB.\nGPU 0 has 1 GiB"),
    RuntimeError("Failed to allocate 1048576 bytes on device 'cuda:0'"),
    RuntimeError("[enforce fail] DefaultCPUAllocator: can't allocate memory: you tried to allocate 9 bytes"),
    RuntimeError("Graph creation error: Warp CUDA error 2: out of memory (in function wp_cuda_graph_create_exec)"),
    MemoryError(),
]


def fail_with(monkeypatch, owner, name, error, calls=0):
    """Let the method `name` raise the error after some successful calls."""
    method, done = getattr(owner, name), []

    def fail(*args, **kwargs):
        if len(done) == calls:
            raise type(error)(*error.args)  # without the notes of other tests
        done.append(True)
        return method(*args, **kwargs)

    monkeypatch.setattr(owner, name, fail)


@pytest.mark.parametrize("error", ERRORS, ids=lambda error: type(error).__name__)
def test_training_reports_its_number_of_worlds_while_it_builds(capsys, monkeypatch, tmp_path, error):
    fail_with(monkeypatch, Env, "__init__", error)
    code, _, err = run(capsys, "train", *ARGS, "--log-root", str(tmp_path))
    assert code == 1 and not (tmp_path / "vertical-jump").exists()
    advice = "; num_envs 8 does not fit: lower --num-envs, --ppo.num-steps or --ppo.hidden"
    assert err[-1].startswith("jumper: ") and "out of memory" in err[-1] and err[-1].endswith(advice)


def test_training_resumes_after_it_ran_out_of_memory(capsys, monkeypatch, tmp_path):
    with monkeypatch.context() as patch:
        fail_with(patch, Ppo, "update", ERRORS[0], calls=2)
        code, _, err = run(capsys, "train", *ARGS, "--log-root", str(tmp_path))
    (folder,) = (tmp_path / "vertical-jump").iterdir()
    assert code == 1 and err[-1].endswith(f" --resume {folder}") and "continue from the last checkpoint" in err[-1]
    code, out, _ = run(capsys, *err[-1].partition(" with: jumper ")[2].split())
    assert (code, out.strip()) == (0, str(folder))
    assert (folder / "checkpoints" / "iteration_000003.pt").exists()
