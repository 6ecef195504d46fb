"""How many threads the CPU's worlds are shared out to, and jobs that run side by side."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable
from queue import SimpleQueue
from threading import Thread

from jumper_warp.utils.errors import InputError

_chosen: int | None = None
_helpers: list[Thread] = []
_asked: SimpleQueue[Callable[[], None]] = SimpleQueue()
"""Work for them; a plain queue wakes a thread four times as fast as an executor."""


def available_threads() -> int:
    """Return the CPU cores that this process may use; processes of one torchrun on one machine share them."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return max(1, cores // max(1, int(os.environ.get("LOCAL_WORLD_SIZE", "1"))))


def checked_threads(threads: int | None) -> int:
    """Return a number of threads; None is what `set_threads` chose. Raises ValueError: no whole number above 0."""
    if threads is None:
        return available_threads() if _chosen is None else _chosen
    if isinstance(threads, bool) or not isinstance(threads, int) or threads < 1:
        raise InputError(f"threads must be a whole number of at least 1, got {threads!r:.60}")
    return threads


def set_threads(threads: int | None) -> None:
    """Choose the threads of all simulations that are made from now on; None: `available_threads`.

    Raises ValueError as `checked_threads`.
    """
    global _chosen
    _chosen = None if threads is None else checked_threads(threads)


def run_in_parallel(jobs: Iterable[Callable[[], object]], threads: int) -> None:
    """Run jobs on so many threads, of which the caller's is one, and return when all have ended.

    Raises what one of them raised; jobs that no thread has begun by then are left out.
    """
    jobs = list(jobs)
    helpers = min(threads, len(jobs)) - 1
    left, ended = iter(jobs), SimpleQueue()

    def work() -> None:
        error = None
        try:
            for job in left:
                job()
        except BaseException as raised:  # of any kind: the caller waits for all, and raises it
            error = raised
            for _ in left:  # nothing more is begun
                pass
        ended.put(error)

    while len(_helpers) < helpers:
        _helpers.append(Thread(target=_help, name=f"worlds_{len(_helpers)}", daemon=True))
        _helpers[-1].start()
    for _ in range(helpers):
        _asked.put(work)
    work()
    errors = [ended.get() for _ in range(helpers + 1)]
    for error in errors:
        if error is not None:
            raise error


def _help() -> None:
    """Do what is asked for, for ever."""
    while True:
        _asked.get()()
