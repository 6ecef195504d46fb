"""Capture of repeated procedures as CUDA graphs, which later calls replay."""

from __future__ import annotations

import sys
from collections.abc import Callable

import torch

from jumper_warp.rl.distributed import all_ranks_agree, wait_for_ranks


class CapturedProcedure:
    """Procedure that runs eagerly in its first call and, if enabled, as a captured CUDA graph in all later calls.

    If the capture fails on any rank, all ranks run the procedure eagerly, and print a warning.
    """

    def __init__(
        self, procedure: Callable[[], object], enabled: bool, generator: torch.Generator | None = None
    ) -> None:
        """Wrap a procedure; it uses the same tensors in every call and does not synchronise with the host.

        generator: a random generator of its own that the procedure draws from.
        """
        self._procedure = procedure
        self._generator = generator
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
        """Capture the procedure as a CUDA graph; if that fails on any rank, disable capture on all ranks."""
        torch.cuda.synchronize()
        wait_for_ranks()  # no collective of an eager call may be in progress on any rank
        graph, reason = torch.cuda.CUDAGraph(), ""
        if self._generator is not None:
            graph.register_generator_state(self._generator)
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
