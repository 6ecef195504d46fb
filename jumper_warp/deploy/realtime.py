"""Motor loop in real time: one tick after the other under SCHED_FIFO, with a short spin before each."""

from __future__ import annotations

import gc
import os
import sys
import time
from collections.abc import Callable
from typing import Any

import numpy as np

SPIN = 1.0e-4  # [s] before each tick without sleeping; a loop without sleep would be throttled by the kernel
PRIORITY = 80  # of SCHED_FIFO


def request_real_time() -> None:
    """Give the process the real-time priority PRIORITY, or print a warning."""
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(PRIORITY))
    except (PermissionError, AttributeError) as error:
        print(f"no real-time priority ({error}): ticks will be late; run with CAP_SYS_NICE", file=sys.stderr)


def run_loop(tick: Callable[[float], object], rate: int, seconds: float) -> dict[str, Any]:
    """Call `tick` with its lateness [s] at a rate [Hz] until the time is over.

    A tick that begins more than a period late drops the periods in between. Returns the statistics of `statistics`.
    """
    period = 1.0 / rate
    begin = due = time.monotonic() + period
    times: list[tuple[float, float]] = []  # lateness and work of each tick
    missed = 0
    gc.collect()
    gc.freeze()
    gc.disable()
    try:
        while due - begin < seconds:
            time.sleep(max(0.0, due - time.monotonic() - SPIN))
            while (now := time.monotonic()) < due:
                pass
            tick(now - due)
            times.append((now - due, time.monotonic() - now))
            due += period
            while due + period < time.monotonic():
                due += period
                missed += 1
    finally:
        gc.enable()
        gc.unfreeze()
    return statistics(np.array(times).T, missed, period)


def statistics(times: np.ndarray, missed: int, period: float) -> dict[str, Any]:
    """Return quantiles of lateness and work, (2, n) [s], the share of missed ticks, and the load of a tick."""
    count = times.shape[1]
    result: dict[str, Any] = {"ticks": count, "missed": missed / max(1, count + missed)}
    for quantile in (0.5, 0.99, 0.999, 1.0):
        for name, value in zip(("late", "work"), np.quantile(times, quantile, axis=1), strict=True):
            result[f"{name}_p{100 * quantile:g}_us"] = 1.0e6 * float(value)
    return result | {"work_p99_of_tick": result["work_p99_us"] / (1.0e6 * period)}
