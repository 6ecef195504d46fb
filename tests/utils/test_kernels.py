import threading

import pytest
import warp as wp

from jumper_warp.utils.kernels import load_kernels


@wp.kernel(module="unique")
def first_kernel(out: wp.array[float]):
    out[wp.tid()] = 1.0


@wp.kernel(module="unique")
def second_kernel(out: wp.array[float]):
    out[wp.tid()] = 2.0


@pytest.fixture
def uses(monkeypatch):
    """Record the threads that read a device's context or load a module, in order."""
    wp.init()
    uses, device_type = [], type(wp.get_device("cpu"))
    context, force_load = device_type.context.fget, wp.force_load

    def read_context(device):
        uses.append(("context", threading.current_thread()))
        return context(device)

    def load(*args):
        uses.append(("load", threading.current_thread()))
        return force_load(*args)

    monkeypatch.setattr(device_type, "context", property(read_context))
    monkeypatch.setattr(wp, "force_load", load)
    return uses


def test_a_device_is_initialised_before_other_threads_use_it(uses):
    load_kernels([(first_kernel, 256), (second_kernel, 256)], wp.get_device("cpu"))
    assert uses[0] == ("context", threading.main_thread())
    assert sum(use == "load" for use, _ in uses) == 2
