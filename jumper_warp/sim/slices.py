"""Worlds in slices, which a CPU advances side by side: what is launched for one reads and writes no other.

Warp runs a launch on one thread of a CPU. Launches of a slice begin at its first world and have as many threads as it
has worlds; all of a step are captured as one graph a slice, and threads replay the graphs. Nothing is summed across
worlds, so that the bits depend neither on the slices nor on the threads.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import warp as wp

from jumper_warp.utils.threads import run_side_by_side

LEAST = 16
"""Worlds of the smallest slice: fewer are not worth a thread, and two slices share no cache line of an array's row."""


class WorldRange(NamedTuple):
    """Worlds from `first` on, `count` of them."""

    first: int
    count: int


def slices_of(num_worlds: int, threads: int) -> list[WorldRange]:
    """Return the worlds in at most so many slices of about the same size; one slice of a few worlds."""
    count = max(1, min(threads, num_worlds // LEAST))
    begins = [LEAST * (num_worlds // LEAST * i // count) for i in range(count)]
    return [WorldRange(a, b - a) for a, b in itertools.pairwise([*begins, num_worlds])]


class SlicedGraph:
    """What is launched for each slice, captured; `replay` launches all."""

    def __init__(self, launch: Callable[[WorldRange], None], slices: list[WorldRange], device: wp.Device) -> None:
        """Capture; launch: launches everything for some worlds, whose kernels are loaded."""
        self._device, self._graphs = device, []
        for worlds in slices:
            with wp.ScopedCapture(device=device) as capture:
                launch(worlds)
            self._graphs.append(capture.graph)

    def replay(self) -> None:
        """Launch all; on a CPU slices run side by side, and have ended when this returns."""
        if len(self._graphs) == 1:
            wp.capture_launch(self._graphs[0])
        else:
            run_side_by_side([partial(wp.capture_launch, graph) for graph in self._graphs], len(self._graphs))
