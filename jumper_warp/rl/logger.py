"""Where a training's figures go: a file, the terminal, TensorBoard and Weights & Biases."""

from __future__ import annotations

import importlib
import math
import time
from contextlib import suppress
from itertools import pairwise
from pathlib import Path
from types import TracebackType
from typing import Any

import torch
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TimeElapsedColumn, TimeRemainingColumn

from jumper_warp.rl.metrics_file import MetricsFile
from jumper_warp.utils.errors import InputError

METRICS_FILE = "metrics.jsonl"
"""In a run's folder: one JSON object per logged iteration."""
REWARDS = "Episode_Reward/"
"""In the names of reward terms' means."""


class Stopwatch:
    """Seconds that a device spends between marks, without waiting for it until they are read."""

    def __init__(self, device: torch.device) -> None:
        self._cuda, self._since = device.type == "cuda", time.perf_counter()
        self._laps: list[list[Any]] = []

    def start(self) -> None:
        """Begin a lap."""
        self._laps.append([])
        self.mark()

    def mark(self) -> None:
        """End a part of the lap."""
        mark: Any = torch.cuda.Event(enable_timing=True) if self._cuda else time.perf_counter()
        if self._cuda:
            mark.record()
        self._laps[-1].append(mark)

    def read(self) -> tuple[list[float], float]:
        """Return mean seconds of each part since the last call, and of an iteration on the host's clock.

        Waits for the device. Time between laps counts to the iterations.
        """
        laps, self._laps = self._laps, []
        if self._cuda:
            torch.cuda.synchronize()
            seconds = [[a.elapsed_time(b) / 1.0e3 for a, b in pairwise(lap)] for lap in laps]
        else:
            seconds = [[b - a for a, b in pairwise(lap)] for lap in laps]
        since, self._since = self._since, time.perf_counter()
        return [sum(part) / len(part) for part in zip(*seconds, strict=True)], (self._since - since) / len(laps)


class TrainingLog:
    """Context in which figures are logged. Nothing that cannot be written stops the training; it is told once."""

    def __init__(
        self,
        folder: Path,
        config: dict[str, Any],
        total: int,
        tensorboard: bool = True,
        wandb: bool = False,
        iteration: int = 0,
    ) -> None:
        """folder: the run's, exists. config: everything that the run was started with, ready for JSON.

        total: iterations that the run has at its end. tensorboard: write events. wandb: upload to Weights & Biases.
        iteration: how many the run has had; what was logged of later ones is dropped.
        Raises ValueError: Weights & Biases is requested and not installed. OSError: the metrics cannot be read or
        written.
        """
        self._console = _LastingConsole(stderr=True)
        self._figures = MetricsFile(folder / METRICS_FILE, iteration)
        self._events = _event_writer(folder, iteration) if tensorboard else None
        self._full = False
        self._total = total
        self._wandb = _wandb(folder, config) if wandb else None
        columns = (BarColumn(bar_width=24), MofNCompleteColumn(), TimeElapsedColumn(), TimeRemainingColumn())
        hidden = not self._console.is_terminal
        self._progress = Progress("{task.description}", *columns, console=self._console, disable=hidden)
        self._task = self._progress.add_task("training", total=total)

    def __enter__(self) -> TrainingLog:
        self._progress.start()
        if self._figures.dropped:
            self.say(f"{self._figures.path}: dropped {self._figures.dropped} lines, cut or of later iterations")
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._progress.stop()
        for file in (self._figures, self._events):
            with suppress(OSError):
                if file:
                    file.close()
        if self._wandb:
            self._wandb.finish()

    def say(self, line: str) -> None:
        """Print a line above the progress."""
        with suppress(OSError):  # where would that be told
            self._console.print(line, markup=False, highlight=False, soft_wrap=True)

    def log(self, iteration: int, figures: dict[str, float], left: float) -> None:
        """Log figures under names such as `Loss/value`; `iteration` have been done, for the rest `left` [s] is left."""
        try:
            self._figures.add(iteration, figures)
        except OSError as error:
            if not self._full:
                path = self._figures.path
                self.say(f"{path}: {error.strerror}; training continues, the metrics follow when there is room")
            self._full = True
        self._write_events(iteration, figures)
        if self._wandb:
            self._wandb.log(figures, step=iteration)
        summary = _summary(figures)
        self._progress.update(self._task, completed=iteration, description=summary)
        if not self._console.is_terminal:
            self.say(f"iteration {iteration}/{self._total}: {summary}, {_duration(left)} left")
        for name in _broken_terms(figures):
            self.say(f"reward term {name} was not a finite number in some steps, where it counts as 0: mend it")

    def _write_events(self, iteration: int, figures: dict[str, float]) -> None:
        """Write TensorBoard's events; after a failure none are written any more."""
        if not self._events:
            return
        try:
            for name, value in figures.items():
                self._events.add_scalar(name, value, iteration)
            self._events.flush()
        except OSError as error:
            self.say(
                f"no TensorBoard events from iteration {iteration} on: {error.strerror}; {METRICS_FILE} has them all"
            )
            with suppress(OSError):
                self._events.close()
            self._events = None


class _LastingConsole(Console):
    """Falls silent when its reader is gone, where rich would end the process."""

    def on_broken_pipe(self) -> None:
        self.quiet = True


def _summary(figures: dict[str, float]) -> str:
    """Return the few figures to watch, in one line."""
    parts = [f"{figures['Perf/fps']:,.0f} steps/s"]
    if (total := figures.get("Train/mean_return")) is not None:
        parts.append(f"return {total:.2f}")
    if (success := figures.get("Metrics/success")) is not None:
        parts.append(f"success {100.0 * success:.1f} %")
    return ", ".join(parts)


def _broken_terms(figures: dict[str, float]) -> list[str]:
    """Return the names of reward terms whose means are not finite."""
    means = {name.replace(REWARDS, ""): value for name, value in figures.items() if REWARDS in name}
    return [name for name, value in means.items() if not math.isfinite(value)]


def _duration(seconds: float) -> str:
    """Return a duration in words, to the second, minute or minute of an hour."""
    if seconds < 59.5:
        return f"{seconds:.0f} s"
    hours, minutes = divmod(round(seconds / 60.0), 60)
    return f"{hours} h {minutes} min" if hours else f"{minutes} min"


def _event_writer(folder: Path, iteration: int) -> Any:
    """Return a writer of a new file of events, which hides events after `iteration` in older ones."""
    from torch.utils.tensorboard import SummaryWriter

    return SummaryWriter(str(folder), purge_step=iteration + 1 if iteration else None)


def _wandb(folder: Path, config: dict[str, Any]) -> Any:
    try:
        wandb = importlib.import_module("wandb")
    except ImportError as error:
        raise InputError("wandb is requested but not installed: pip install wandb") from error
    return wandb.init(project="jumper-warp", dir=str(folder), config=config)
