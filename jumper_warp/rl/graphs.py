"""Torch functions compiled by torch.compile, and procedures captured as CUDA graphs."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable
from typing import Any

import torch

from jumper_warp.rl.distributed import all_ranks_agree, wait_for_ranks

BACKEND = "inductor"
"""Of torch.compile."""


class Compiler:
    """Compiles functions if asked to; where that fails, says so once and runs them as they are.

    A function is compiled, or read from Inductor's cache on disk, at its first call; the shapes of its tensors and its
    other arguments stay the same from then on.
    """

    def __init__(self, enabled: bool) -> None:
        """enabled: whether to compile at all."""
        self.enabled = enabled

    def __call__(self, function: Callable[..., Any]) -> Callable[..., Any]:
        """Return a function that computes the same."""
        if not self.enabled:
            return function
        compiled: Callable[..., Any] | None = None

        def call(*args: Any) -> Any:
            nonlocal compiled
            if compiled is not None:
                return compiled(*args)
            if not self.enabled:
                return function(*args)
            try:
                tried = torch.compile(function, fullgraph=True, dynamic=False, backend=BACKEND, options=_options())
                result = tried(*args)
            except Exception as error:  # whatever a compiler, or none, does
                self.enabled = False
                print(f"not compiled, training is slower: {_reason(error)}", file=sys.stderr)
                return function(*args)
            compiled = tried
            return result

        return call


def _options() -> dict[str, str | int | bool | Callable[..., Any]] | None:
    """Return options of Inductor: it may not choose by time between kernels that add up in another order.

    ATEN_CPU_CAPABILITY limits its vectors too: PyTorch 2.13 would compile AVX-512 code against headers of the limit.
    """
    if BACKEND != "inductor":
        return None
    from torch._inductor import config

    options: dict[str, str | int | bool | Callable[..., Any]] = {}
    if hasattr(config, "deterministic"):
        options["deterministic"] = True
    simdlen = {"avx2": 256, "default": 1}.get(os.environ.get("ATEN_CPU_CAPABILITY", ""))
    if simdlen is not None:
        options["cpp.simdlen"] = simdlen
    return options


def _reason(error: Exception) -> str:
    inner = getattr(error, "inner_exception", error)  # of a backend's failure
    lines = [line.strip() for line in str(inner).splitlines() if line.strip()]
    return f"{type(inner).__name__}: {lines[0] if lines else ''}"[:300]


class CapturedProcedure:
    """A procedure that, if enabled, runs eagerly once and as a CUDA graph from then on.

    Where it cannot be captured, on any rank, all ranks go on eagerly, and say so.
    """

    def __init__(self, procedure: Callable[[], object], enabled: bool) -> None:
        """procedure: reads and writes the same tensors in every call, and waits for no result."""
        self._procedure = procedure
        self.enabled = enabled
        self._graph: torch.cuda.CUDAGraph | None = None
        self._warm = False

    def close(self) -> None:
        """Drop the graph; NCCL does not end a group while a graph holds exchanges of it."""
        self._graph = None

    def __call__(self) -> None:
        """Run the procedure once."""
        if self.enabled and self._warm and self._graph is None:
            self._capture()
        if self._graph is not None:
            self._graph.replay()
        else:
            self._procedure()
            self._warm = True

    def _capture(self) -> None:
        torch.cuda.synchronize()
        wait_for_ranks()  # no exchange of an eager call may be under way on any rank
        graph, reason = torch.cuda.CUDAGraph(), ""
        current = torch.cuda.current_stream()
        stream = None if current == torch.cuda.default_stream() else current
        try:
            # the thread that watches NCCL asks for events, which another mode would take for a mistake of the capture
            with torch.cuda.graph(graph, stream=stream, capture_error_mode="thread_local"):
                self._procedure()
        except RuntimeError as error:
            reason = f": {str(error).splitlines()[0]}"[:300]
        self.enabled = all_ranks_agree(not reason)
        if self.enabled:
            self._graph = graph
        else:
            print(f"not captured as a CUDA graph, training is slower{reason}", file=sys.stderr)
