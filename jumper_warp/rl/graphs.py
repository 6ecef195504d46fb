"""Compilation of torch functions with torch.compile, and capture of procedures as CUDA graphs."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable
from typing import Any

import torch

from jumper_warp.rl.distributed import all_ranks_agree, wait_for_ranks

BACKEND = "inductor"  # Backend of torch.compile


class Compiler:
    """Wrapper of functions with torch.compile; after a failure it prints one warning and runs them eagerly.

    A function is compiled, or read from Inductor's cache on disk, at its first call. The shapes of its tensors and its
    other arguments must stay the same afterwards.
    """

    def __init__(self, enabled: bool) -> None:
        """Create a compiler; if not `enabled`, it returns functions unchanged."""
        self.enabled = enabled

    def __call__(self, function: Callable[..., Any]) -> Callable[..., Any]:
        """Return a function with the same arguments and result, compiled at its first call."""
        if not self.enabled:
            return function
        compiled: Callable[..., Any] | None = None

        def call(*args: Any) -> Any:
            """Call the compiled function, or the eager function if compilation failed."""
            nonlocal compiled
            if compiled is not None:
                return compiled(*args)
            if not self.enabled:
                return function(*args)
            try:
                tried = torch.compile(function, fullgraph=True, dynamic=False, backend=BACKEND, options=_options())
                result = tried(*args)
            except Exception as error:  # compilers raise many types
                self.enabled = False
                print(f"torch.compile failed, training is slower: {_failure_reason(error)}", file=sys.stderr)
                return function(*args)
            compiled = tried
            return result

        return call


def _options() -> dict[str, str | int | bool | Callable[..., Any]] | None:
    """Return Inductor's options for deterministic results: timing must not select kernels that sum in another order.

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


def _failure_reason(error: Exception) -> str:
    """Return type and first line of an error's message, at most 300 characters."""
    inner = getattr(error, "inner_exception", error)  # of a backend's failure
    lines = [line.strip() for line in str(inner).splitlines() if line.strip()]
    return f"{type(inner).__name__}: {lines[0] if lines else ''}"[:300]


class CapturedProcedure:
    """Procedure that runs eagerly once; if enabled, it is then captured and replayed as a CUDA graph.

    If the capture fails on any rank, all ranks run the procedure eagerly, and print a warning.
    """

    def __init__(self, procedure: Callable[[], object], enabled: bool) -> None:
        """Wrap a procedure; it uses the same tensors in every call and does not synchronise with the host."""
        self._procedure = procedure
        self.enabled = enabled
        self._graph: torch.cuda.CUDAGraph | None = None
        self._warm = False

    def close(self) -> None:
        """Delete the graph; NCCL cannot destroy a process group whose collectives a graph holds."""
        self._graph = None

    def __call__(self) -> None:
        """Run the procedure once, as a graph if it has been captured."""
        if self.enabled and self._warm and self._graph is None:
            self._capture()
        if self._graph is not None:
            self._graph.replay()
        else:
            self._procedure()
            self._warm = True

    def _capture(self) -> None:
        """Capture the procedure as a graph, or disable capture on all ranks."""
        torch.cuda.synchronize()
        wait_for_ranks()  # no collective of an eager call may be in progress on any rank
        graph, reason = torch.cuda.CUDAGraph(), ""
        current = torch.cuda.current_stream()
        stream = None if current == torch.cuda.default_stream() else current
        try:
            # NCCL's watchdog thread queries events, which invalidates a capture in any other mode
            with torch.cuda.graph(graph, stream=stream, capture_error_mode="thread_local"):
                self._procedure()
        except RuntimeError as error:
            reason = f": {str(error).splitlines()[0]}"[:300]
        self.enabled = all_ranks_agree(not reason)
        if self.enabled:
            self._graph = graph
        else:
            print(f"CUDA graph capture failed, training is slower{reason}", file=sys.stderr)
