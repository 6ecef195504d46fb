"""Logging of a training's metrics: to a file, the terminal, TensorBoard and Weights & Biases."""

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
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn
from rich.table import Column

from jumper_warp.rl.metrics_file import METRICS_FILE, MetricsFile
from jumper_warp.utils.errors import InputError
from jumper_warp.utils.progress import format_duration


class Stopwatch:
    """Stopwatch for the device time of the parts of each training iteration (or lap); only `read` synchronises."""

    def __init__(self, device: torch.device) -> None:
        """Measure the time of `device`, with CUDA events on a GPU and the host's clock on a CPU."""
        self._cuda, self._since = device.type == "cuda", time.perf_counter()
        self._laps: list[list[Any]] = []  # marks of each lap: CUDA events, or times [s]

    def start(self) -> None:
        """Begin a lap (iteration) and its first part."""
        self._laps.append([])
        self.mark()

    def mark(self) -> None:
        """End a part of the current lap and begin the next part."""
        mark: Any = torch.cuda.Event(enable_timing=True) if self._cuda else time.perf_counter()
        if self._cuda:
            mark.record()
        self._laps[-1].append(mark)

    def lap_time(self) -> float:
        """Return the time from the start of the current lap to its last mark [s] on a CPU, and 0 on a GPU."""
        return 0.0 if self._cuda else self._laps[-1][-1] - self._laps[-1][0]

    def read(self) -> tuple[list[float], float]:
        """Return the mean time of each part [s] over the laps since the last call, and the host time per lap [s].

        Synchronises with the device. All laps have the same number of parts. The host time includes gaps between laps.
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
    """Context manager that logs metrics of a training. A failure to write prints one warning, training continues."""

    def __init__(
        self, folder: Path, config: dict[str, Any], total: int, steps: int, tensorboard: bool = True,
        wandb: bool = False, iteration: int = 0, expected_rate: float = 0.0,
    ) -> None:  # fmt: skip
        """Open the metrics file and the other outputs of the log; folder: the run's existing folder.

        config: JSON-ready configuration of the run. total: largest number of iterations. steps: environment steps per
        iteration, of all worlds. tensorboard: whether to write events. wandb: whether to upload to Weights & Biases.
        iteration: iterations so far; lines logged of later iterations are removed. expected_rate: as in
        `jumper_warp.rl.runner.train`.
        Raises InputError: Weights & Biases is requested but not installed. OSError: the metrics file cannot be used.
        """
        self._console = _PipeSafeConsole(stderr=True)
        self._file = MetricsFile(folder / METRICS_FILE, iteration)
        self._events = _event_writer(folder, iteration) if tensorboard else None
        self._disk_full = False
        self._total, self._steps = total, steps
        self._first, self._expected_rate = iteration + 1, expected_rate
        self._wandb = _wandb(folder, config) if wandb else None
        wrapped = TextColumn("{task.description}", table_column=Column(no_wrap=False))
        columns, hidden = (TimeElapsedColumn(), BarColumn(bar_width=12), wrapped), not self._console.is_terminal
        self._progress = Progress(*columns, console=self._console, disable=hidden)
        self._task = self._progress.add_task("training", total=None)

    def __enter__(self) -> TrainingLog:
        """Show the training's progress bar; report lines that were removed from the metrics file."""
        self._progress.start()
        if self._file.dropped:
            self.print_line(f"{self._file.path}: removed {self._file.dropped} incomplete or later lines")
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Close all outputs of the log: file, terminal, TensorBoard and Weights & Biases."""
        for close in (self._progress.stop, self._file.close, *([self._events.close] if self._events else [])):
            with suppress(OSError):  # such as that of a closed terminal
                close()
        if self._wandb:
            self._wandb.finish()

    def print_line(self, line: str) -> None:
        """Print a line above the progress bar; a failure to print it (OSError) is ignored."""
        with suppress(OSError):
            self._console.print(line, markup=False, highlight=False, soft_wrap=True)

    def log(self, iteration: int, metrics: dict[str, float], remaining: float) -> None:
        """Log the metrics of an iteration by name, such as `Loss/value`; remaining: estimated time to the end [s]."""
        try:
            self._file.add(iteration, metrics)
        except OSError as error:
            if not self._disk_full:
                path = self._file.path
                self.print_line(f"{path}: {error.strerror}; training continues, the metrics are written later")
            self._disk_full = True
        self._write_events(iteration, metrics)
        if self._wandb:
            self._wandb.log(metrics, step=iteration)
        elapsed = metrics["Perf/elapsed_s"]
        progress = f"iteration {iteration}/{self._total}, {iteration * self._steps / 1.0e6:.2f} M steps"
        line = f"{progress}: {_summary(metrics)}, {format_duration(remaining)} left"
        self._progress.update(self._task, completed=elapsed, total=elapsed + remaining, description=line)
        if not self._console.is_terminal:
            self.print_line(line)
        if iteration > self._first:
            self.check_rate(metrics["Perf/total_fps"])

    def print_speed(self, rate: float, remaining: float) -> None:
        """Print the measured step rate [1/s] and the estimated time to the end [s]; warn if the rate is low."""
        self.print_line(f"measured speed: {rate:,.0f} steps/s, about {format_duration(remaining)} left")
        self.check_rate(rate)

    def check_rate(self, rate: float) -> None:
        """Print a warning, once, if the step rate [1/s] is less than half of the expected one."""
        if 2.0 * rate < self._expected_rate:
            usual = f"below {self._expected_rate / 2.0:,.0f} steps/s, {self._expected_rate:,.0f} are usual on two cores"
            waiting = ", or restart with OMP_NUM_THREADS=1, since torch's threads wait for them"
            advice = f"close other programs that use the cores{waiting if torch.get_num_threads() > 1 else ''}"
            self.print_line(f"slow: {usual}; {advice}")
            self._expected_rate = 0.0

    def move(self, folder: Path) -> None:
        """Continue the log in a new folder: copy the metrics file, even if deleted; end TensorBoard. Raises OSError."""
        self._file = self._file.move(folder / METRICS_FILE)
        self._events = None

    def _write_events(self, iteration: int, metrics: dict[str, float]) -> None:
        """Write an iteration's metrics as TensorBoard events; the first failure disables events."""
        if not self._events:
            return
        try:
            for name, value in metrics.items():
                self._events.add_scalar(name, value, iteration)
            self._events.flush()
        except OSError as error:
            self.print_line(
                f"no TensorBoard events from iteration {iteration} on: {error.strerror}; see {METRICS_FILE} instead"
            )
            with suppress(OSError):
                self._events.close()
            self._events = None


class Scores:
    """Values of the metric that selects the best checkpoint, since the checkpoint before."""

    def __init__(self, metric: str) -> None:
        """Begin without values; metric: name of the logged metric, higher is better."""
        self._metric = metric
        self._values: list[float] = []

    def add(self, metrics: dict[str, float]) -> None:
        """Add the value of a log line, if half of the worlds have reached the last curriculum level.

        Success at easy levels says little about the whole task, and would make an early checkpoint the best one.
        """
        levels, score = level_fractions(metrics), metrics.get(self._metric, math.nan)
        at_end = sum(levels[-2:])  # worlds at the last level, and those that passed it
        if math.isfinite(score) and (not levels or at_end >= 0.5):
            self._values.append(score)

    def mean(self) -> float | None:
        """Return the mean of the values, None without any."""
        return sum(self._values) / len(self._values) if self._values else None

    def clear(self) -> None:
        """Remove all values, since a checkpoint has them."""
        self._values = []


class NoLog:
    """Null object for `TrainingLog` on all ranks but 0: it discards everything."""

    def __enter__(self) -> NoLog:
        """Return this log, which discards everything."""
        return self

    def __exit__(self, *_: object) -> None:
        """Do nothing, since no output is open."""

    def print_line(self, line: str) -> None:
        """Discard the line."""

    def print_speed(self, rate: float, remaining: float) -> None:
        """Discard the speed."""

    def check_rate(self, rate: float) -> None:
        """Discard the step rate."""

    def log(self, iteration: int, metrics: dict[str, float], remaining: float) -> None:
        """Discard the metrics."""


class _PipeSafeConsole(Console):
    """Console that stops printing on a broken pipe, where `rich.console.Console` would end the process."""

    def on_broken_pipe(self) -> None:
        """Disable all further output; rich calls this method after a broken pipe."""
        self.quiet = True


def _summary(metrics: dict[str, float]) -> str:
    """Return one line with steps per second and, if in metrics, reward, success rate and curriculum level."""
    parts = [f"{metrics['Perf/total_fps']:,.0f} steps/s"]
    if (total := metrics.get("Train/mean_reward")) is not None:
        parts.append(f"reward {total:.2f}")
    if (success := metrics.get("Metrics/success")) is not None:
        parts.append(f"success {100.0 * success:.1f} %")
    if len(levels := level_fractions(metrics)) > 2:  # with a single level there is no curriculum
        level = f"mean level {sum(i * part for i, part in enumerate(levels)):.1f} of {len(levels) - 1}"
        parts.append(level if success is None else f"{parts.pop()} at {level}")
    return ", ".join(parts)


def level_fractions(metrics: dict[str, float]) -> list[float]:
    """Return the fraction of worlds at each curriculum level and, last, of those that passed all; [] if not logged."""
    return [value for name, value in metrics.items() if name.startswith("Curriculum/fraction_at_level_")]


def _event_writer(folder: Path, iteration: int) -> Any:
    """Return a TensorBoard writer that hides events after `iteration` in older event files."""
    from torch.utils.tensorboard import SummaryWriter

    return SummaryWriter(str(folder), purge_step=iteration + 1 if iteration else None)


def _wandb(folder: Path, config: dict[str, Any]) -> Any:
    """Start a run of Weights & Biases for a training, and return it. Raises InputError: it is not installed."""
    try:
        wandb = importlib.import_module("wandb")
    except ImportError as error:
        raise InputError("wandb is requested but not installed: pip install wandb") from error
    return wandb.init(project="jumper-warp", dir=str(folder), config=config)
