"""Torch procedures as CUDA graphs."""

from __future__ import annotations

import sys
from collections.abc import Callable

import torch

from jumper_warp.rl.distributed import all_ranks, wait_for_ranks


class Captured:
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
        self.enabled = all_ranks(not reason)
        if self.enabled:
            self._graph = graph
        else:
            print(f"not captured as a CUDA graph, training is slower{reason}", file=sys.stderr)
