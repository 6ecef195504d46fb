"""Wall time of work on a device, memory in use, and age of the process."""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import warp as wp


def wall_time(function: Callable[[], Any], device: wp.DeviceLike = None, calls: int = 1) -> float:
    """Return the mean wall time [s] of `calls` calls; waits for the device before the first and after the last."""
    wp.synchronize_device(device)
    start = time.perf_counter()
    for _ in range(calls):
        function()
    wp.synchronize_device(device)
    return (time.perf_counter() - start) / calls


def median_time(function: Callable[[], Any], device: wp.DeviceLike = None, calls: int = 1, repeats: int = 5) -> float:
    """Return the median of `wall_time` [s] over repetitions of `calls` calls each."""
    return float(np.median([wall_time(function, device, calls) for _ in range(repeats)]))


def process_age() -> float:
    """Return the time since the start of this process [s]; Linux only."""
    ticks = int(Path("/proc/self/stat").read_text().rsplit(")", 1)[1].split()[19])  # start time, field 22
    return time.clock_gettime(time.CLOCK_BOOTTIME) - ticks / os.sysconf("SC_CLK_TCK")


def device_memory(device: wp.Device) -> int:
    """Return the memory in use on a GPU [byte], 0 on a CPU."""
    return device.total_memory - device.free_memory if device.is_cuda else 0
