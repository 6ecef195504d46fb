"""Trials of the fault campaign: each disturbs and resumes a training, and compares it with an undisturbed one."""

from __future__ import annotations

import contextlib
import os
import re
import shutil
import signal
import subprocess
import time
from collections.abc import Callable, Iterator, Mapping
from functools import cache, partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from jumper_warp.rl.checkpoint import MANIFEST, latest_checkpoint
from jumper_warp.rl.runner import CHECKPOINTS, INTERRUPTED
from jumper_warp.utils.errors import InputError
from support import faults
from support.faults import Action

SIGNALS = (signal.SIGKILL, signal.SIGKILL, signal.SIGTERM, signal.SIGINT)  # SIGKILL in half of the kills
SEEDS = 3  # Number of different seeds of trainings
START_SECONDS = 1.5  # [s] Processor time in which a training starts or resumes
ITERATION_SECONDS = 0.05  # [s] Processor time of an iteration
CLOCK_JUMPS = (-3.2e8, -86400.0, -3600.0, 3600.0, 86400.0, 3.2e8)  # [s]
DISK_BYTES = 16_000_000  # Size of the disk that is filled


class Event(NamedTuple):
    """A fault that happened, and how many iterations a training had to repeat after it."""

    fault: str
    lost: int = 0


class Reference(NamedTuple):
    """Result of an undisturbed training."""

    digest: dict[str, str]  # checksum of each part of the last checkpoint
    logged: list[dict[str, Any]]  # metrics of each iteration
    operations: int  # number of file operations in its folder


class Trial:
    """One training with faults: its folder, its random number generator, and the list of its faults (`events`)."""

    def __init__(self, seed: int, number: int, folder: Path) -> None:
        """Create an empty folder; the random numbers are a function of the campaign's seed and the trial's number."""
        self.rng = np.random.default_rng([seed, number])
        self.training_seed = int(self.rng.integers(SEEDS))
        self.folder, self.events, self.text, self.lives = folder, list[Event](), "", 0
        shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir(parents=True)
        self.root = folder / "logs"

    def choose(self, *options: Any) -> Any:
        """Return one of the options at random."""
        return options[int(self.rng.integers(len(options)))]

    def start(self, before: Action = lambda: None, ranks: int = 1, restarts: int = 0) -> tuple[int, Path]:
        """Start a training that resumes the last run, if there is one; return the process id and the log file.

        before: called in the new process, of every rank, before the training; a function that it returns is called
        after the training. ranks, restarts: as `launch_ranks`.
        """
        log, self.lives = self.folder / f"life_{self.lives}.log", self.lives + 1
        args = ["--seed", str(self.training_seed), "--log-root", str(self.root), "--resume", "latest-or-new"]

        def job() -> None:
            after = before()
            faults.train(args)
            if callable(after):
                after()

        return faults.fork(partial(faults.launch_ranks, job, ranks, restarts) if ranks > 1 else job, log), log

    def run(self, before: Action = lambda: None, ranks: int = 1, restarts: int = 0) -> int:
        """Run a training to its end, store its output in `text`, and return the exit code; arguments: as of `start`."""
        pid, log = self.start(before, ranks, restarts)
        code = faults.wait(pid)
        self.text = log.read_text()
        check(ranks > 1 or "Traceback" not in self.text, f"{log.name}: traceback, exit code {code}")
        return code

    def operation(self, start: float = 0.0, end: float = 1.0) -> int:
        """Return the index, from 1, of a random file operation in a part of the remaining training.

        start, end: begin and end of the part, as fractions of the remaining training.
        """
        total, done = reference(self.training_seed, 1, self.folder.parent).operations, self.saved_iteration()
        rest = total * (1.0 - done / faults.ITERATIONS)
        return 1 + int(rest * self.rng.uniform(start, end))

    def run_folder(self) -> Path | None:
        """Return the folder of the last run, if possible one with checkpoints; None: there is no run."""
        folders = sorted(self.root.glob("*/*"))
        return next(reversed([path for path in folders if (path / CHECKPOINTS / MANIFEST).is_file()] or folders), None)

    def saved_iteration(self) -> int:
        """Return the iteration of the last usable checkpoint, 0 without one. Raises CheckpointError: it is damaged."""
        folder = self.run_folder()
        if folder is None or not (folder / CHECKPOINTS / MANIFEST).is_file():
            return 0
        return latest_checkpoint(folder / CHECKPOINTS).state["iteration"]

    def add(self, fault: str) -> None:
        """Append a fault of the training that has just ended, and the number of iterations lost to it, to `events`."""
        reached = [int(number) for number in re.findall(r"^iteration (\d+)/", self.text, re.MULTILINE)]
        self.events.append(Event(fault, max(0, max(reached, default=0) - self.saved_iteration())))

    def finish(self, ranks: int = 1) -> None:
        """Resume the training to its end; check that checkpoint and metrics are those of an undisturbed training."""
        code = self.run(ranks=ranks)
        check(code == 0, f"exit code {code} of the last training: {self.text[-300:]}")
        folder, expected = self.run_folder(), reference(self.training_seed, ranks, self.folder.parent)
        assert folder is not None
        checkpoint = latest_checkpoint(folder / CHECKPOINTS)
        found = faults.digest(checkpoint.state)
        parts = [part for part, value in expected.digest.items() if found[part] != value]
        check(not parts, f"the last checkpoint differs in {', '.join(parts)}")
        check(not checkpoint.skipped, f"skipped: {checkpoint.skipped}")
        check(faults.logged(folder) == expected.logged, "the logged metrics differ")
        left = sorted(path.name for path in folder.rglob("*.part"))
        check(not left, f"files left: {left}")


class Unexpected(Exception):
    """Raised when a training of a trial ends with an unexpected exit code, output or result."""


def check(expected: bool, text: str) -> None:
    """Raise Unexpected with a text unless `expected`."""
    if not expected:
        raise Unexpected(text)


@cache
def reference(seed: int, ranks: int, folder: Path) -> Reference:
    """Return the result of an undisturbed training; only the first call with these arguments trains.

    folder: of the campaign, in which the training gets a subfolder.
    """
    trial = Trial(0, 0, folder / f"reference_{seed}_{ranks}")
    trial.training_seed, counted = seed, trial.folder / "operations"

    def before() -> Action:
        count = faults.on_file_operations(trial.root, {})
        return lambda: counted.write_text(str(count()))

    code = trial.run(before, ranks)
    check(code == 0, f"exit code {code} of an undisturbed training: {trial.text[-300:]}")
    run = trial.run_folder()
    assert run is not None
    state = latest_checkpoint(run / CHECKPOINTS).state
    return Reference(faults.digest(state), faults.logged(run), int(counted.read_text()))


def kills(trial: Trial, clock: bool = False) -> None:
    """Kill a training two to six times while it starts, trains, saves or resumes; clock: also move the clock."""
    for _ in range(int(trial.rng.integers(2, 7))):
        moment, number = trial.choose("starting", "training", "saving", "saving"), trial.choose(*SIGNALS)
        if moment == "starting" and trial.saved_iteration():
            moment = "resuming"
        operation, fraction = trial.operation(), trial.rng.uniform(0.02, 1.0)
        jump = trial.choose(*CLOCK_JUMPS) if clock else 0.0
        send = partial(send_signal, number)

        def before(moment=moment, operation=operation, fraction=fraction, jump=jump, send=send) -> None:
            if jump:
                faults.shift_clock(jump)
            later = partial(faults.after_processor_time, fraction * ITERATION_SECONDS, send)
            if moment in ("starting", "resuming"):
                faults.after_processor_time(fraction * START_SECONDS, send)
            else:
                faults.on_file_operations(trial.root, {operation: later if moment == "training" else send})

        code = trial.run(before)
        expected = [-number] if number == signal.SIGKILL else [-number, INTERRUPTED]
        check(code in (0, *expected), f"exit code {code} after {number.name}: {trial.text[-300:]}")
        if code:
            trial.add(f"{number.name} while {moment}" + (", clock moved" if clock else ""))
            lost = trial.events[-1].lost
            limit = 0 if code == INTERRUPTED else faults.SAVE_INTERVAL
            check(lost <= limit, f"{lost} iterations lost after {number.name}, exit code {code}")
        if jump:
            for path in trial.root.rglob("*"):
                os.utime(path, times=(time.time() + jump, time.time() + jump))
    trial.finish()


def send_signal(number: signal.Signals) -> None:
    """Send a signal to this process."""
    os.kill(os.getpid(), number)


@contextlib.contextmanager
def small_disk(folder: Path) -> Iterator[None]:
    """Mount a small disk on a folder while the block runs; needs root on Linux."""
    folder.mkdir()
    subprocess.run(["mount", "-t", "tmpfs", "-o", f"size={DISK_BYTES}", "tmpfs", str(folder)], check=True)
    try:
        yield
    finally:
        subprocess.run(["umount", "-l", str(folder)], check=True)


def disturb(trial: Trial, name: str, begin: Action, end: Action, prepare: Action = lambda: None) -> None:
    """Run a training with a disturbance from a random file operation to a later one or to the end; then finish it."""
    passes = bool(trial.rng.integers(2))
    first = trial.operation(0.1, 0.9)
    last = first + int(trial.rng.integers(1, 40))

    def before() -> None:
        prepare()
        faults.on_file_operations(trial.root, {first: begin, **({last: end} if passes else {})})

    code = trial.run(before)
    end()
    check(code in (0, 2), f"exit code {code}: {trial.text[-300:]}")
    if code == 2:
        check(len(re.findall(r"^jumper: ", trial.text, re.MULTILINE)) == 1, f"no line of an error: {trial.text[-300:]}")
    trial.add(f"{name}, exit code {code}")
    trial.finish()


def full_disk(trial: Trial) -> None:
    """Fill the disk while a training runs."""
    left = int(trial.rng.integers(0, 400_000))
    with small_disk(trial.root):
        filler = trial.root / "filler"
        disturb(trial, "full disk", partial(faults.fill_disk, trial.root, left), lambda: filler.unlink(missing_ok=True))


def read_only(trial: Trial) -> None:
    """Make the folder of logs read-only before a training, or this folder and its subfolders during a training."""
    trial.root.mkdir()

    def allow(mode: int) -> None:
        for path in [trial.root, *(path for path in trial.root.rglob("*") if path.is_dir())]:
            path.chmod(mode)

    if trial.rng.uniform() < 0.3:
        allow(0o555)
        code = trial.run(faults.drop_privileges)
        allow(0o755)
        check(code == 2 and "Permission denied" in trial.text, f"exit code {code}: {trial.text[-300:]}")
        trial.add("read-only log folder, exit code 2")
        trial.finish()
    else:
        disturb(trial, "read-only folder", partial(allow, 0o555), partial(allow, 0o755), faults.drop_privileges)


def deleted(trial: Trial) -> None:
    """Delete a run's folder, or a part of it, while the training runs."""
    what = trial.choose("folder", "folder", "checkpoints", "config.json", "metrics.jsonl")
    operation = trial.operation(0.05, 1.0)

    def delete() -> None:
        folder = trial.run_folder()
        path = folder if folder is None or what == "folder" else folder / what
        if path is not None and path.is_dir():
            shutil.rmtree(path, ignore_errors=True)
        elif path is not None:
            path.unlink(missing_ok=True)

    code = trial.run(lambda: faults.on_file_operations(trial.root, {operation: delete}))
    check(code in (0, 1, 2), f"exit code {code}: {trial.text[-300:]}")
    trial.add(f"{'run folder' if what == 'folder' else what} deleted, exit code {code}")
    trial.finish()


def writers(trial: Trial) -> None:
    """Resume a run in three processes at once."""
    operation = trial.operation(0.4, 0.7)
    code = trial.run(lambda: faults.on_file_operations(trial.root, {operation: partial(send_signal, signal.SIGTERM)}))
    check(code == INTERRUPTED, f"exit code {code} after SIGTERM")
    delays = trial.rng.uniform(0.0, 2.0, 3)
    started = [trial.start(partial(time.sleep, delay)) for delay in delays]
    codes = [faults.wait(pid) for pid, _ in started]
    texts = [log.read_text() for _, log in started]
    check(0 in codes, f"no writer has finished: {codes}")
    for code, text in zip(codes, texts, strict=True):
        check(code == 0 or (code == 2 and "another process" in text), f"exit code {code}: {text[-300:]}")
    trial.events.append(Event(f"three writers, {codes.count(2)} refused"))
    trial.finish()


def killed_rank(trial: Trial) -> None:
    """Kill one of two ranks of a training under torchrun, with no restart or one restart allowed."""
    rank, restarts, operation = trial.choose(0, 1), trial.choose(0, 1), trial.operation(0.1, 0.9)

    def kill() -> None:
        os.kill(int((trial.folder / f"pid_{rank}").read_text()), signal.SIGKILL)

    def before() -> None:
        own = os.environ["RANK"]
        (trial.folder / f"pid_{own}").write_text(str(os.getpid()))
        if own == "0" and os.environ["TORCHELASTIC_RESTART_COUNT"] == "0":
            faults.on_file_operations(trial.root, {operation: kill})

    code = trial.run(before, ranks=2, restarts=restarts)
    check(code == (0 if restarts else 1), f"exit code {code}: {trial.text[-300:]}")
    trial.add(f"SIGKILL of rank {rank} of 2 under torchrun, {'a restart' if restarts else 'no restart'}")
    trial.finish(ranks=2)


TRIALS: Mapping[str, Callable[[Trial], None]] = {
    "kills": kills, "full_disk": full_disk, "read_only": read_only, "deleted": deleted, "writers": writers,
    "killed_rank": killed_rank, "clock": partial(kills, clock=True),
}  # fmt: skip
"""Trials by the name of their fault."""


def run_trial(fault: str, seed: int, number: int, folder: Path) -> dict[str, Any]:
    """Run a trial of a fault in a subfolder, which stays only if something unexpected happened, and return its result.

    The result has the faults with the iterations that were lost to each, and the unexpected event as text, if any.
    """
    trial, begin, unexpected = Trial(seed, number, folder / f"trial_{number}"), time.monotonic(), ""
    try:
        TRIALS[fault](trial)
        shutil.rmtree(trial.folder)
    except (Unexpected, InputError, TimeoutError) as error:
        unexpected = " ".join(str(error).split())
    return {
        "trial": number, "kind": fault, "seed": seed, "training_seed": trial.training_seed, "faults": trial.events,
        "unexpected": unexpected, "seconds": round(time.monotonic() - begin, 1),
    }  # fmt: skip
