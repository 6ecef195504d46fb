"""Torch procedures as CUDA graphs."""

from __future__ import annotations

import warnings
from collections.abc import Callable

import torch


class Captured:
    """A procedure that, if enabled, runs eagerly once and as a CUDA graph from then on."""

    def __init__(self, procedure: Callable[[], None], enabled: bool) -> None:
        """procedure: reads and writes the same tensors in every call, and waits for no result."""
        self._procedure = procedure
        self.enabled = enabled
        self.forget()

    def forget(self) -> None:
        """Drop the graph, because a tensor that it uses has been replaced."""
        self._graph: torch.cuda.CUDAGraph | None = None
        self._warm = False

    def __call__(self) -> None:
        """Run the procedure once."""
        if not (self.enabled and self._warm):
            with warnings.catch_warnings():
                warnings.filterwarnings("ignore", "This instance was constructed with capturable=True")
                self._procedure()
            self._warm = True
            return
        if self._graph is None:
            self._graph = torch.cuda.CUDAGraph()
            current = torch.cuda.current_stream()
            stream = None if current == torch.cuda.default_stream() else current
            with torch.cuda.graph(self._graph, stream=stream, capture_error_mode="thread_local"):
                self._procedure()
        self._graph.replay()
