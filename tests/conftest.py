import pytest
import torch
import warp as wp

wp.config.log_level = wp.LOG_WARNING


@pytest.fixture(scope="module")
def one_thread():
    """Torch computes on one thread: small networks lose more to waiting threads than they gain."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(threads)
