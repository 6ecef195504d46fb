"""Number of CPU threads of simulations and of torch, a pool of worker threads for jobs, and a lock of Warp's state."""

from __future__ import annotations

import functools
import os
import sys
from collections.abc import Callable, Iterable
from queue import SimpleQueue
from threading import RLock, Thread
from typing import Any, ParamSpec, TypeVar

from jumper_warp.utils.checks import check_count
from jumper_warp.utils.errors import InputError

MAX_THREADS = 1024  # Largest number of threads of a simulation
MOST_PROCESSES = 100_000  # Largest number of processes of a training
P = ParamSpec("P")
T = TypeVar("T")
FORKED = "a forked process cannot use CUDA: start it with multiprocessing.get_context('spawn')"
SPIN_COUNT = "20000"  # Rounds in which an idle thread of torch waits for work before it sleeps; libgomp's own: 300,000
_default_threads: int | None = None
_torch_spins = False  # whether torch was loaded with libgomp's own number of rounds
_workers: list[Thread] = []
_jobs: SimpleQueue[Callable[[], None]] = SimpleQueue()
"""Jobs for the workers; a plain queue wakes a thread four times as fast as an executor."""


class WarpLock:
    """Reentrant lock of Warp's process-wide state, for module loading, allocations, launches and graph captures.

    While one thread captures a graph, a launch of another thread would become part of it. Replays of CPU graphs need no
    lock. A forked child process cannot use CUDA after its parent did: there the lock raises RuntimeError.
    """

    def __init__(self) -> None:
        """Create the lock, and let forks of this process wait until no thread holds it."""
        self._lock = RLock()
        self._used = False
        self._forked = False
        release = self._lock.release
        os.register_at_fork(before=self._lock.acquire, after_in_parent=release, after_in_child=self._after_fork)

    def __enter__(self) -> None:
        """Acquire the lock. Raises RuntimeError: this is a forked process whose parent had a CUDA device."""
        if self._forked:
            raise RuntimeError(FORKED)
        self._lock.acquire()
        self._used = True

    def __exit__(self, *_: object) -> None:
        """Release the lock."""
        self._lock.release()

    def _after_fork(self) -> None:
        """Prepare a forked child process, in which the parent's worker threads and those of torch do not exist."""
        global _jobs
        self._lock.release()
        self._forked = self._used and sys.modules["warp"].is_cuda_available()
        _jobs = SimpleQueue()
        _workers.clear()
        if "torch" in sys.modules:
            sys.modules["torch"].set_num_threads(1)


WARP_LOCK = WarpLock()


def locked(function: Callable[P, T]) -> Callable[P, T]:
    """Return a version of a function that holds `WARP_LOCK` while it runs."""

    @functools.wraps(function)
    def call(*args: P.args, **kwargs: P.kwargs) -> Any:
        """Call the function while holding the lock."""
        with WARP_LOCK:
            return function(*args, **kwargs)

    return call


def torchrun_variable(name: str, default: int = 1, least: int = 1, most: int = MOST_PROCESSES) -> int:
    """Return the number in one of torchrun's environment variables, such as WORLD_SIZE, or `default` without it.

    Raises InputError: it is not a whole number from `least` to `most`.
    """
    text = os.environ.get(name, str(default))
    if not (text.isdecimal() and least <= int(text) <= most):
        raise InputError(
            f"the environment variable {name} must be a whole number of {least} to {most}, got {text!r:.40}"
        )
    return int(text)


def available_threads() -> int:
    """Return the number of CPU cores for this process: its affinity, divided by torchrun's processes on the machine."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return max(1, cores // torchrun_variable("LOCAL_WORLD_SIZE"))


def checked_threads(threads: int | None) -> int:
    """Check a number of CPU threads and return it; None: the default of `set_threads`.

    Raises InputError: it is not in 1 to MAX_THREADS.
    """
    if threads is None:
        return available_threads() if _default_threads is None else _default_threads
    return check_count("threads", threads, MAX_THREADS)


def set_threads(threads: int | None) -> None:
    """Set the default number of threads of new simulations (None: `available_threads`); raises as `checked_threads`."""
    global _default_threads
    _default_threads = None if threads is None else checked_threads(threads)


def limit_spinning() -> None:
    """Make torch's idle CPU threads sleep soon, which frees cores for the simulation; call it before importing torch.

    libgomp reads the number of rounds when torch is loaded. If that was earlier, `stop_spinning` helps.
    """
    global _torch_spins
    if not {"OMP_WAIT_POLICY", "GOMP_SPINCOUNT"} & set(os.environ):
        os.environ["GOMP_SPINCOUNT"] = SPIN_COUNT
        _torch_spins = "torch" in sys.modules


def stop_spinning() -> None:
    """Limit torch to one CPU thread if its idle threads spin (see `limit_spinning`) and OMP_NUM_THREADS is not set.

    Spinning threads would occupy the cores of the simulation.
    """
    global _torch_spins
    if _torch_spins and "OMP_NUM_THREADS" not in os.environ:
        sys.modules["torch"].set_num_threads(1)
    _torch_spins = False


def run_in_parallel(jobs: Iterable[Callable[[], object]], threads: int) -> None:
    """Run jobs in parallel on `threads` threads, including the calling thread, and wait until all have finished.

    If a job raises, jobs that have not started are skipped, and its exception is raised here.
    """
    jobs = list(jobs)
    workers = min(threads, len(jobs)) - 1
    remaining = iter(jobs)
    errors = SimpleQueue()

    def work() -> None:
        """Run jobs until none remains; put the exception that one of them raised, or None, into `errors`."""
        error = None
        try:
            for job in remaining:
                job()
        except BaseException as raised:  # the caller waits for all threads, and raises it
            error = raised
            for _ in remaining:  # skip the rest
                pass
        errors.put(error)

    if len(_workers) < workers:
        with WARP_LOCK:
            while len(_workers) < workers:
                worker = Thread(target=_run_jobs, name=f"worlds_{len(_workers)}", daemon=True)
                worker.start()
                _workers.append(worker)
    for _ in range(workers):
        _jobs.put(work)
    work()
    for error in [errors.get() for _ in range(workers + 1)]:
        if error is not None:
            raise error


def _run_jobs() -> None:
    """Loop of a worker thread: take jobs of `run_in_parallel` calls from the queue and run them, without end.

    It is a daemon thread, which ends with the process.
    """
    while True:
        _jobs.get()()
