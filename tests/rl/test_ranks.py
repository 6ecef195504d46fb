import pytest
import torch

from jumper_warp.rl import distributed


@pytest.mark.parametrize(("cores", "threads"), [(1, 1), (2, 2), (3, 2), (4, 2), (16, 8)])
def test_torch_has_half_the_cores_but_two_where_there_are(cores, threads, one_thread, monkeypatch):
    monkeypatch.delenv("OMP_NUM_THREADS", raising=False)
    monkeypatch.setattr(distributed, "available_threads", lambda: cores)
    assert distributed.join_ranks("cpu").size == 1
    assert torch.get_num_threads() == threads


def test_torchs_threads_stay_where_the_environment_names_them(one_thread, monkeypatch):
    monkeypatch.setenv("OMP_NUM_THREADS", "3")
    torch.set_num_threads(1)
    distributed.join_ranks("cpu")
    assert torch.get_num_threads() == 1
