import dataclasses

import pytest
import torch

from jumper_warp.rl import distributed
from jumper_warp.rl.runner import train
from jumper_warp.utils.threads import set_threads
from toy_task import PushTask, push_cfg


@pytest.mark.parametrize(("cores", "threads"), [(1, 1), (2, 2), (3, 2), (4, 2), (16, 8)])
def test_torch_uses_half_the_cores_and_at_least_two(cores, threads, one_thread, monkeypatch):
    monkeypatch.delenv("OMP_NUM_THREADS", raising=False)
    monkeypatch.setattr(distributed, "available_threads", lambda: cores)
    assert distributed.init_distributed("cpu").size == 1
    assert torch.get_num_threads() == threads


def test_set_omp_num_threads_leaves_torchs_threads_unchanged(one_thread, monkeypatch):
    monkeypatch.setenv("OMP_NUM_THREADS", "3")
    torch.set_num_threads(1)
    distributed.init_distributed("cpu")
    assert torch.get_num_threads() == 1


def test_torch_uses_the_threads_of_the_training_settings(one_thread, monkeypatch, tmp_path):
    monkeypatch.delenv("OMP_NUM_THREADS", raising=False)
    cfg = push_cfg(tmp_path, max_iterations=1)
    for threads in (1, 3):
        train(dataclasses.replace(cfg, threads=threads), PushTask)
        assert torch.get_num_threads() == threads
    set_threads(None)
