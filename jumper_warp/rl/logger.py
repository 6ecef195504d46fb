"""Logging of a training's metrics: to a file, the terminal, TensorBoard and Weights & Biases."""

from __future__ import annotations

import importlib
import math
import time
from collections.abc import Sequence
from contextlib import suppress
from itertools import pairwise
from pathlib import Path
from typing import Any

import torch
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn
from rich.table import Column

from jumper_warp.rl.cfg import TrainCfg
from jumper_warp.rl.events_file import EventsFile
from jumper_warp.rl.metrics_file import METRICS_FILE, MetricsFile
from jumper_warp.rl.run_names import SEED, title
from jumper_warp.utils.errors import InputError
from jumper_warp.utils.metrics import mean
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


class TrainingConsole:
    """Context manager of the terminal's lines and progress bar of a training, or of several seeds together."""

    def __init__(self, cfg: TrainCfg, *, quiet: bool = False) -> None:
        """Prepare the terminal; cfg: of the training. quiet: print nothing."""
        self._console = _PipeSafeConsole(stderr=True, quiet=quiet)
        self._total, self._steps = cfg.max_iterations, cfg.ppo.num_steps * cfg.num_envs * max(1, len(cfg.seeds))
        wrapped = TextColumn("{task.description}", table_column=Column(no_wrap=False))
        columns, hidden = (TimeElapsedColumn(), BarColumn(bar_width=12), wrapped), not self._console.is_terminal
        self._progress = Progress(*columns, console=self._console, disable=hidden)
        self._task = self._progress.add_task("training", total=None)
        self._logged: list[dict[str, float]] = []

    def __enter__(self) -> TrainingConsole:
        """Show the training's progress bar."""
        self._progress.start()
        return self

    def __exit__(self, *_: object) -> None:
        """Remove the progress bar."""
        with suppress(OSError):  # such as that of a closed terminal
            self._progress.stop()

    def print_line(self, line: str) -> None:
        """Print a line above the progress bar; a failure to print it (OSError) is ignored."""
        with suppress(OSError):
            self._console.print(line, markup=False, highlight=False, soft_wrap=True)

    def add(self, iteration: int, metrics: dict[str, float], remaining: float) -> None:
        """Keep the metrics of a seed for the next `flush`; remaining: estimated time to the end [s]."""
        self._logged.append(metrics)
        self._iteration, self._remaining = iteration, remaining

    def flush(self) -> None:
        """Show the metrics that were logged since the last call, if any; of several seeds, means and intervals."""
        seeds, self._logged = self._logged, []
        if not seeds:
            return
        elapsed = max(metrics["Perf/elapsed_s"] for metrics in seeds)
        rate = sum(metrics["Perf/total_fps"] for metrics in seeds)
        progress = f"iteration {self._iteration}/{self._total}, {self._iteration * self._steps / 1.0e6:.2f} M steps"
        line = f"{progress}: {rate:,.0f} steps/s{_summary(seeds)}, {format_duration(self._remaining)} left"
        self._progress.update(self._task, completed=elapsed, total=elapsed + self._remaining, description=line)
        if not self._console.is_terminal:
            self.print_line(line)


class TrainingLog:
    """Context manager that logs metrics of a training. A failure to write prints one warning, training continues."""

    def __init__(
        self, folder: Path, config: dict[str, Any], cfg: TrainCfg, console: TrainingConsole, iteration: int = 0
    ) -> None:
        """Open the metrics file and the other outputs of the log; folder: the run's existing folder.

        config: JSON-ready configuration of the run. cfg: settings of the training. console: that shows lines and
        progress. iteration: iterations so far; lines logged of later iterations are removed.
        Raises InputError: Weights & Biases is requested but not installed. OSError: the metrics file cannot be used.
        """
        self._console = console
        self._prefix = f"seed {cfg.seed}: " if folder.name.startswith(SEED) else ""
        self._file = MetricsFile(folder / METRICS_FILE, iteration)
        self._events = EventsFile(folder, iteration, config) if cfg.tensorboard else None
        self._disk_full = False
        self._wandb = _wandb(cfg.wandb, folder, config, cfg) if cfg.wandb else None

    def __enter__(self) -> TrainingLog:
        """Report lines that were removed from the metrics file."""
        if self._file.dropped:
            self.print_line(f"{self._file.path}: removed {self._file.dropped} incomplete or later lines")
        return self

    def __exit__(self, *_: object) -> None:
        """Close all outputs of the log: file, TensorBoard and Weights & Biases."""
        for close in (self._file.close, *([self._events.close] if self._events else [])):
            with suppress(OSError):
                close()
        if self._wandb:
            self._wandb.finish()

    def print_line(self, line: str) -> None:
        """Print a line above the progress bar, of one of several seeds with the seed."""
        self._console.print_line(self._prefix + line)

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
        self._console.add(iteration, metrics, remaining)

    def _write_events(self, iteration: int, metrics: dict[str, float]) -> None:
        """Write an iteration's metrics as TensorBoard events; the first failure disables events."""
        if not self._events:
            return
        try:
            self._events.add(iteration, metrics)
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

    def log(self, iteration: int, metrics: dict[str, float], remaining: float) -> None:
        """Discard the metrics."""


class _PipeSafeConsole(Console):
    """Console that stops printing on a broken pipe, where `rich.console.Console` would end the process."""

    def on_broken_pipe(self) -> None:
        """Disable all further output; rich calls this method after a broken pipe."""
        self.quiet = True


def _summary(seeds: Sequence[dict[str, float]]) -> str:
    """Return reward, success rate and curriculum level as text, those that the metrics of all seeds have.

    Of several seeds: means, in brackets their 95 % intervals over the seeds.
    """
    parts = [""]
    if reward := _mean_over(seeds, "Train/mean_reward", "reward {:.2f}", "[{:.2f}, {:.2f}]"):
        parts.append(reward)
    if success := _mean_over(seeds, "Metrics/success", "success {:.1%}", "[{:.1%}, {:.1%}]"):
        parts.append(success.replace("%", " %"))
    levels = [level_fractions(metrics) for metrics in seeds]
    if len(levels[0]) > 2:  # with a single level there is no curriculum
        mean = sum(i * part for each in levels for i, part in enumerate(each)) / len(levels)
        level = f"mean level {mean:.1f} of {len(levels[0]) - 1}"
        parts.append(f"{parts.pop()} at {level}" if success else level)
    return ", ".join(parts).replace(", success nan %", "")  # without an ended episode


def _mean_over(seeds: Sequence[dict[str, float]], name: str, form: str, interval: str) -> str:
    """Return the mean of a metric over seeds as text, in brackets its interval if there are several; "": not logged.

    form: format string of the mean, such as "reward {:.2f}"; interval: of the lower and upper end, such as
    "[{:.2f}, {:.2f}]". The mean is over the finite values. Without any, the first value (NaN or infinite) is formatted.
    """
    values = [metrics[name] for metrics in seeds if name in metrics]
    if not values:
        return ""
    measured = mean(values)
    if len(seeds) == 1 or measured.value is None or measured.interval is None:
        return form.format(values[0] if measured.value is None else measured.value)
    return f"{form.format(measured.value)} {interval.format(*measured.interval)}"


def level_fractions(metrics: dict[str, float]) -> list[float]:
    """Return the fraction of worlds at each curriculum level and, last, of those that passed all; [] if not logged."""
    return [value for name, value in metrics.items() if name.startswith("Curriculum/fraction_at_level_")]


def _wandb(project: str, folder: Path, config: dict[str, Any], cfg: TrainCfg) -> Any:
    """Start a run of Weights & Biases for a training, and return it; seeds of a run form a group.

    Raises InputError: it is not installed.
    """
    try:
        wandb = importlib.import_module("wandb")
    except ImportError as error:
        raise InputError("wandb is requested but not installed: pip install wandb") from error
    group = title(folder.parent) if folder.name.startswith(SEED) else None
    return wandb.init(
        project=project, dir=str(folder), config=config, name=title(folder), group=group, tags=list(cfg.tags),
        reinit="create_new",
    )  # fmt: skip
