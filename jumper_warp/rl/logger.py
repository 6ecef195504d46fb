"""Where a training's figures go: a file, the terminal, TensorBoard and Weights & Biases."""

from __future__ import annotations

import json
import time
from itertools import pairwise
from pathlib import Path
from types import TracebackType
from typing import Any, Protocol

import torch
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

FIGURES = "metrics.jsonl"
"""In a run's folder: one JSON object per logged iteration."""


class Writer(Protocol):
    """Takes scalars under a name, as TensorBoard's SummaryWriter does."""

    def add_scalar(self, tag: str, scalar_value: float, global_step: int) -> None:
        """Log one figure."""

    def close(self) -> None:
        """Write out what is left."""


class Stopwatch:
    """Seconds that a device spends between marks, without waiting for it until they are read."""

    def __init__(self, device: torch.device) -> None:
        self._cuda = device.type == "cuda"
        self._laps: list[list[Any]] = []

    def start(self) -> None:
        """Begin a lap."""
        self._laps.append([])
        self.mark()

    def mark(self) -> None:
        """End a part of the lap."""
        if not self._cuda:
            self._laps[-1].append(time.perf_counter())
            return
        event = torch.cuda.Event(enable_timing=True)
        event.record()
        self._laps[-1].append(event)

    def read(self) -> list[float]:
        """Return the mean seconds of each part over all laps since the last call; waits for the device."""
        laps, self._laps = self._laps, []
        if self._cuda:
            torch.cuda.synchronize()
            seconds = [[a.elapsed_time(b) / 1.0e3 for a, b in pairwise(lap)] for lap in laps]
        else:
            seconds = [[b - a for a, b in pairwise(lap)] for lap in laps]
        return [sum(part) / len(part) for part in zip(*seconds, strict=True)]


class TrainingLog:
    """Context in which figures are logged; silent on all ranks but the first."""

    def __init__(
        self, folder: Path, config: dict[str, Any], total: int, tensorboard: bool = True, wandb: bool = False
    ) -> None:
        """Args:

        folder: The run's, exists.
        config: Everything that the run was started with, ready for JSON.
        total: Iterations that the run is to have at its end.
        tensorboard: Write events, if TensorBoard is installed.
        wandb: Upload to Weights & Biases.

        Raises:
            ValueError: Weights & Biases is asked for and not installed.
        """
        self._console = Console(stderr=True)
        self._file = (folder / FIGURES).open("a")
        self._writers = [writer for writer in (tensorboard and _tensorboard(folder),) if writer]
        self._wandb = _wandb(folder, config) if wandb else None
        self._progress = Progress(
            TextColumn("{task.description}"),
            BarColumn(bar_width=24),
            MofNCompleteColumn(),
            TimeElapsedColumn(),
            TimeRemainingColumn(),
            console=self._console,
            disable=not self._console.is_terminal,
        )
        self._task = self._progress.add_task("training", total=total)

    def __enter__(self) -> TrainingLog:
        """Show the progress."""
        self._progress.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Close everything."""
        self._progress.stop()
        self._file.close()
        for writer in self._writers:
            writer.close()
        if self._wandb:
            self._wandb.finish()

    def say(self, line: str) -> None:
        """Print a line above the progress."""
        self._console.print(line, markup=False, highlight=False, soft_wrap=True)

    def log(self, iteration: int, figures: dict[str, float]) -> None:
        """Log figures under names such as `Loss/value`; `iteration` have been done."""
        self._file.write(json.dumps({"iteration": iteration, **figures}) + "\n")
        self._file.flush()
        for writer in self._writers:
            for name, value in figures.items():
                writer.add_scalar(name, value, iteration)
        if self._wandb:
            self._wandb.log(figures, step=iteration)
        summary = _summary(figures)
        self._progress.update(self._task, completed=iteration, description=summary)
        if not self._console.is_terminal:
            self.say(f"iteration {iteration}: {summary}")


def _summary(figures: dict[str, float]) -> str:
    """Return the few figures to watch, in one line."""
    parts = [f"{figures['Perf/fps']:,.0f} steps/s"]
    if "Train/mean_return" in figures:
        parts.append(f"return {figures['Train/mean_return']:.2f}")
    if "Metrics/success" in figures:
        parts.append(f"success {100.0 * figures['Metrics/success']:.1f} %")
    return ", ".join(parts)


def _tensorboard(folder: Path) -> Writer | None:
    try:
        from torch.utils.tensorboard import SummaryWriter
    except ImportError:
        return None
    return SummaryWriter(str(folder))


def _wandb(folder: Path, config: dict[str, Any]) -> Any:
    try:
        import wandb
    except ImportError as error:
        raise ValueError("wandb is asked for but not installed: pip install wandb") from error
    return wandb.init(project="jumper-warp", dir=str(folder), config=config)
