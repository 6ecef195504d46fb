import pytest

from jumper_warp.rl import graphs
from jumper_warp.rl.graphs import CapturedProcedure


@pytest.fixture
def failing_capture(monkeypatch):
    """Replace torch in `graphs` by a stub in which every capture raises, and other calls of torch.cuda do nothing."""

    def refuse(*_, **__):  # as CUDA does where a stream may not be captured
        raise RuntimeError("operation not permitted when stream is capturing\nand more")

    class Cuda:  # every other attribute is a function that does nothing
        CUDAGraph, graph = object, staticmethod(refuse)

        def __getattr__(self, name):
            return lambda: None

    class Torch:  # stub of the module
        cuda = Cuda()

    monkeypatch.setattr(graphs, "torch", Torch())


@pytest.mark.usefixtures("failing_capture")
def test_failed_capture_runs_eagerly_and_warns_once(capsys):
    calls = []
    captured = CapturedProcedure(lambda: calls.append(None), enabled=True)
    for _ in range(4):  # the second call tries to capture
        captured()
    assert len(calls) == 4
    assert capsys.readouterr().err.splitlines() == [
        "CUDA graph capture failed, training is slower: operation not permitted when stream is capturing"
    ]
