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


def request_real_time() -> bool:
    """Give the process the real-time priority PRIORITY; without permission print a warning and return False."""
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(PRIORITY))
    except (PermissionError, AttributeError) as error:
        print(f"no real-time priority ({error}): ticks will be late; run with CAP_SYS_NICE", file=sys.stderr)
        return False
    return True


def run_loop(tick: Callable[[float], object], rate: int, seconds: float) -> dict[str, Any]:
    """Call `tick` with its lateness [s] at a rate [Hz] until the time is over.

    A tick that begins more than a period late drops the periods in between. Returns the statistics of `statistics`.
    """
    period = 1.0 / rate
    begin = due = time.monotonic() + period
    late: list[float] = []
    work: list[float] = []
    missed = 0
    gc.collect()
    gc.freeze()
    gc.disable()
    try:
        while due - begin < seconds:
            rest = due - time.monotonic() - SPIN
            if rest > 0.0:
                time.sleep(rest)
            while (now := time.monotonic()) < due:
                pass
            lateness = now - due
            tick(lateness)
            late.append(lateness)
            work.append(time.monotonic() - now)
            due += period
            while due + period < time.monotonic():
                due += period
                missed += 1
    finally:
        gc.enable()
        gc.unfreeze()
    return statistics(np.array(late), np.array(work), missed, period)


def statistics(late: np.ndarray, work: np.ndarray, missed: int, period: float) -> dict[str, Any]:
    """Return quantiles of lateness and of work (n,) [s], the share of missed ticks, and the load of a tick."""
    result: dict[str, Any] = {"ticks": len(late), "missed": missed / max(1, len(late) + missed)}
    for name, values in (("late", late), ("work", work)):
        for quantile in (0.5, 0.99, 0.999, 1.0):
            result[f"{name}_p{100 * quantile:g}_us"] = 1.0e6 * float(np.quantile(values, quantile))
    result["work_p99_of_tick"] = result["work_p99_us"] / (1.0e6 * period)
    return result
