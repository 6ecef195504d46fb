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
    """Context manager of the terminal's lines and progress bar of a training."""

    brief = False  # Whether the end of a training is left out, since it is printed for all seeds together

    def __init__(self, cfg: TrainCfg) -> None:
        """Prepare the terminal; cfg: of the training."""
        self._console = _PipeSafeConsole(stderr=True)
        self._total, self._steps = cfg.max_iterations, cfg.ppo.num_steps * cfg.num_envs * max(1, len(cfg.seeds))
        wrapped = TextColumn("{task.description}", table_column=Column(no_wrap=False))
        columns, hidden = (TimeElapsedColumn(), BarColumn(bar_width=12), wrapped), not self._console.is_terminal
        self._progress = Progress(*columns, console=self._console, disable=hidden)
        self._task = self._progress.add_task("training", total=None)

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

    def show(self, iteration: int, seeds: Sequence[dict[str, float]], remaining: float) -> None:
        """Show the metrics of each seed in an iteration; remaining: estimated time to the end [s]."""
        elapsed = max(metrics["Perf/elapsed_s"] for metrics in seeds)
        rate = sum(metrics["Perf/total_fps"] for metrics in seeds)
        progress = f"iteration {iteration}/{self._total}, {iteration * self._steps / 1.0e6:.2f} M steps"
        line = f"{progress}: {rate:,.0f} steps/s{_summary(seeds)}, {format_duration(remaining)} left"
        self._progress.update(self._task, completed=elapsed, total=elapsed + remaining, description=line)
        if not self._console.is_terminal:
            self.print_line(line)


class SeedsConsole(TrainingConsole):
    """Terminal of several seeds: one line for all of them, with means and intervals over the seeds."""

    def __init__(self, cfg: TrainCfg, *, quiet: bool = False) -> None:
        """Prepare the terminal; cfg: of the training. quiet: print nothing."""
        super().__init__(cfg)
        self._console.quiet = quiet
        self._logged: dict[int, dict[str, float]] = {}
        self._last = (0, 0.0)

    def of_seed(self, seed: int) -> SeedConsole:
        """Return the console that the log of one seed uses."""
        return SeedConsole(self, seed)

    def add(self, seed: int, iteration: int, metrics: dict[str, float], remaining: float) -> None:
        """Keep the metrics of a seed for the next `flush`."""
        self._logged[seed] = metrics
        self._last = (iteration, remaining)

    def flush(self) -> None:
        """Show the metrics that the seeds have logged since the last call, if any."""
        if self._logged:
            iteration, remaining = self._last
            self.show(iteration, list(self._logged.values()), remaining)
            self._logged = {}


class SeedConsole:
    """Console of one of several seeds: its lines begin with the seed, its metrics are shown with those of others."""

    brief = True

    def __init__(self, console: SeedsConsole, seed: int) -> None:
        """Write to the console of all seeds."""
        self._console, self._seed = console, seed

    def __enter__(self) -> SeedConsole:
        """Return this console; that of all seeds is open."""
        return self

    def __exit__(self, *_: object) -> None:
        """Do nothing: the console of all seeds stays open."""

    def print_line(self, line: str) -> None:
        """Print a line with the seed."""
        self._console.print_line(f"seed {self._seed}: {line}")

    def show(self, iteration: int, seeds: Sequence[dict[str, float]], remaining: float) -> None:
        """Keep the metrics until those of all seeds are shown."""
        self._console.add(self._seed, iteration, seeds[0], remaining)


class TrainingLog:
    """Context manager that logs metrics of a training. A failure to write prints one warning, training continues."""

    def __init__(
        self, folder: Path, config: dict[str, Any], cfg: TrainCfg, iteration: int = 0,
        console: TrainingConsole | SeedConsole | None = None,
    ) -> None:  # fmt: skip
        """Open the metrics file and the other outputs of the log; folder: the run's existing folder.

        config: JSON-ready configuration of the run. cfg: settings of the training. iteration: iterations so far; lines
        logged of later iterations are removed. console: that shows progress (default: a new one).
        Raises InputError: Weights & Biases is requested but not installed. OSError: the metrics file cannot be used.
        """
        self.console = TrainingConsole(cfg) if console is None else console
        self._file = MetricsFile(folder / METRICS_FILE, iteration)
        self._events = EventsFile(folder, iteration, config) if cfg.tensorboard else None
        self._disk_full = False
        self._wandb = _wandb(cfg.wandb, folder, config, cfg) if cfg.wandb else None

    def __enter__(self) -> TrainingLog:
        """Show the training's progress bar; report lines that were removed from the metrics file."""
        self.console.__enter__()
        if self._file.dropped:
            self.print_line(f"{self._file.path}: removed {self._file.dropped} incomplete or later lines")
        return self

    def __exit__(self, *_: object) -> None:
        """Close all outputs of the log: file, terminal, TensorBoard and Weights & Biases."""
        self.console.__exit__()
        for close in (self._file.close, *([self._events.close] if self._events else [])):
            with suppress(OSError):
                close()
        if self._wandb:
            self._wandb.finish()

    def print_line(self, line: str) -> None:
        """Print a line above the progress bar."""
        self.console.print_line(line)

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
        self.console.show(iteration, [metrics], remaining)

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
    return ", ".join(parts)


def _mean_over(seeds: Sequence[dict[str, float]], name: str, form: str, interval: str) -> str:
    """Return the mean of a metric over seeds as text, in brackets its interval if there are several; "": not logged."""
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
