"""Motor loop in real time: one tick after the other under SCHED_FIFO, with a short spin before each."""

from __future__ import annotations

import ctypes
import gc
import os
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from typing import Any

import numpy as np

SPIN = 1.0e-4  # [s] before each tick without sleeping; a loop without sleep would be throttled by the kernel
PRIORITY = 80  # of SCHED_FIFO


@contextmanager
def real_time() -> Iterator[None]:
    """Give the process the priority PRIORITY of SCHED_FIFO in a block and keep its memory in place, or print a warning.

    Afterwards the process has its former priority, and none of its memory is locked.
    """
    libc = ctypes.CDLL(None)
    former = os.sched_getscheduler(0), os.sched_getparam(0)
    libc.mlockall(3)  # present and future pages
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(PRIORITY))
    except PermissionError as error:
        print(f"no real-time priority ({error}): ticks will be late; run with CAP_SYS_NICE", file=sys.stderr)
    try:
        yield
    finally:
        os.sched_setscheduler(0, *former)
        libc.munlockall()


def run_loop(tick: Callable[[float], object], rate: int, seconds: float) -> dict[str, Any]:
    """Call `tick` with its lateness [s] at a rate [Hz] until the time is over, or the operator interrupts.

    A tick that begins more than half a period late drops the next ones, so that they do not begin late too.

    Returns the statistics of `statistics`.
    """
    period = 1.0 / rate
    times: list[tuple[float, float, float]] = []  # lateness, CPU time and duration of each tick
    missed = 0
    with uncollected(), suppress(KeyboardInterrupt):
        begin = due = time.monotonic() + period
        while due - begin < seconds:
            time.sleep(max(0.0, due - time.monotonic() - SPIN))
            while (now := time.monotonic()) < due:
                pass
            used = time.thread_time()
            tick(now - due)
            times.append((now - due, time.thread_time() - used, time.monotonic() - now))
            dropped = round((now - due) / period)
            due += (1 + dropped) * period
            missed += dropped
    return statistics(np.array(times).T, missed, period)


@contextmanager
def uncollected() -> Iterator[None]:
    """Pause the garbage collection in a block."""
    gc.collect()
    gc.freeze()
    gc.disable()
    try:
        yield
    finally:
        gc.enable()
        gc.unfreeze()


def statistics(times: np.ndarray, missed: int, period: float) -> dict[str, Any]:
    """Return quantiles of lateness, work (CPU time) and duration, (3, n) [s], and the share of missed ticks."""
    count = times.shape[1]
    result: dict[str, Any] = {"ticks": count, "missed": missed / max(1, count + missed)}
    for quantile in (0.5, 0.99, 0.999, 1.0):
        for name, value in zip(("late", "work", "duration"), np.quantile(times, quantile, axis=1), strict=True):
            result[f"{name}_p{100 * quantile:g}_us"] = 1.0e6 * float(value)
    return result | {"work_p99_of_tick": result["work_p99_us"] / (1.0e6 * period)}
