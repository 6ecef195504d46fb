"""Number of CPU threads of simulations, and a pool of worker threads for parallel jobs."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable
from queue import SimpleQueue
from threading import Thread

from jumper_warp.utils.errors import InputError

MAX_THREADS = 1024  # Largest number of threads of a simulation
_default_threads: int | None = None
_workers: list[Thread] = []
_jobs: SimpleQueue[Callable[[], None]] = SimpleQueue()
"""Jobs for the workers; a plain queue wakes a thread four times as fast as an executor."""


def available_threads() -> int:
    """Return the number of CPU cores for this process: its affinity, divided by torchrun's processes on the machine."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return max(1, cores // max(1, int(os.environ.get("LOCAL_WORLD_SIZE", "1"))))


def checked_threads(threads: int | None) -> int:
    """Check a number of CPU threads and return it; None: the default of `set_threads`.

    Raises InputError: it is not in 1 to MAX_THREADS.
    """
    if threads is None:
        return available_threads() if _default_threads is None else _default_threads
    if isinstance(threads, bool) or not isinstance(threads, int) or not 1 <= threads <= MAX_THREADS:
        raise InputError(f"threads must be a whole number of 1 to {MAX_THREADS}, got {threads!s:.60}")
    return threads


def set_threads(threads: int | None) -> None:
    """Set the default number of threads of new simulations (None: `available_threads`); raises as `checked_threads`."""
    global _default_threads
    _default_threads = None if threads is None else checked_threads(threads)


def run_in_parallel(jobs: Iterable[Callable[[], object]], threads: int) -> None:
    """Run jobs in parallel on `threads` threads, including the calling thread, and wait until all have finished.

    If a job raises, jobs that have not started are skipped, and its exception is raised here.
    """
    jobs = list(jobs)
    workers = min(threads, len(jobs)) - 1
    remaining, errors = iter(jobs), SimpleQueue()

    def work() -> None:
        """Run jobs that remain, and put the exception that ended them, or None, into `errors`."""
        error = None
        try:
            for job in remaining:
                job()
        except BaseException as raised:  # the caller waits for all threads, and raises it
            error = raised
            for _ in remaining:  # skip the rest
                pass
        errors.put(error)

    while len(_workers) < workers:
        _workers.append(Thread(target=_run_jobs, name=f"worlds_{len(_workers)}", daemon=True))
        _workers[-1].start()
    for _ in range(workers):
        _jobs.put(work)
    work()
    for error in [errors.get() for _ in range(workers + 1)]:
        if error is not None:
            raise error


def _run_jobs() -> None:
    """Run jobs of all `run_in_parallel` calls from the queue, as a worker thread that never ends."""
    while True:
        _jobs.get()()
