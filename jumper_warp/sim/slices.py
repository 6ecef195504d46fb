"""Slices of worlds that CPU threads advance concurrently; a launch for one slice touches no other.

Warp runs a launch on one thread of a CPU. Launches of a slice begin at its first world and have as many threads as it
has worlds; all launches of a step are captured as one graph per slice, and threads replay the graphs. Nothing is summed
across worlds, so that results depend neither on the slices nor on the threads.
"""

from __future__ import annotations

import functools
import itertools
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from functools import partial
from typing import Any, NamedTuple

import warp as wp

from jumper_warp.utils.threads import WARP_LOCK, locked, run_in_parallel

MIN_WORLDS = 16
"""Smallest slice: for fewer worlds a thread costs more than it saves, and slices would share cache lines."""


class WorldRange(NamedTuple):
    """Contiguous range of worlds: first, ..., first + count - 1."""

    first: int
    count: int


def slices_of(num_worlds: int, threads: int) -> list[WorldRange]:
    """Divide all worlds into at most `threads` slices of about equal size; if several, each has at least MIN_WORLDS."""
    count = max(1, min(threads, num_worlds // MIN_WORLDS))
    begins = [MIN_WORLDS * (num_worlds // MIN_WORLDS * i // count) for i in range(count)]
    return [WorldRange(a, b - a) for a, b in itertools.pairwise([*begins, num_worlds])]


@functools.cache
def _capture_stream(device: str) -> wp.Stream:
    """Return the CUDA stream on which only captures of graphs run; device: torch's name of the device.

    It is a stream of torch, since other threads may not use the default stream while a stream of Warp is captured.
    """
    import torch

    return wp.stream_from_torch(torch.cuda.Stream(device))


def _on_capture_stream(device: wp.Device) -> AbstractContextManager[Any]:
    """Return a context in which a device captures a graph on a stream that no other thread's work uses."""
    return wp.ScopedStream(_capture_stream(wp.device_to_torch(device))) if device.is_cuda else nullcontext()


class SlicedGraph:
    """Kernel launches that are captured as one graph for each slice of worlds, and replayed together."""

    @locked
    def __init__(self, launch: Callable[[WorldRange], None], slices: list[WorldRange], device: wp.Device) -> None:
        """Capture the kernel launches of each slice of worlds as a graph.

        launch: function that launches kernels for a slice; their modules must be loaded.
        """
        self._device, self._graphs = device, []
        for worlds in slices:
            with _on_capture_stream(device), wp.ScopedCapture(device=device) as capture:
                launch(worlds)
            self._graphs.append(capture.graph)

    def replay(self) -> None:
        """Replay the captured kernel launches of all slices, concurrently on a CPU.

        With several graphs all have ended when this returns.
        """
        if self._device.is_cuda:  # one graph; a capture changes the device's stream
            with WARP_LOCK:
                wp.capture_launch(self._graphs[0])
        elif len(self._graphs) == 1:
            wp.capture_launch(self._graphs[0])
        else:
            run_in_parallel([partial(wp.capture_launch, graph) for graph in self._graphs], len(self._graphs))
