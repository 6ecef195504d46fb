"""Progress of a training towards its limits: iterations, and time without the start of each process."""

from __future__ import annotations

import time

import torch

from jumper_warp.rl.cfg import TrainCfg


class TrainingClock:
    """Clock of a training over all resumes, and its limits `max_iterations` and `max_seconds`.

    It runs from `start`, which a training calls at the end of a process's first iteration.
    """

    def __init__(self, cfg: TrainCfg) -> None:
        """Read the limits from the settings of a training."""
        self.cfg = cfg
        self.seconds = 0.0  # of the run before this process [s]
        self._begin: float | None = None  # time at which the run would have started without interruption

    def start(self, device: torch.device) -> None:
        """Start counting the training time, after synchronising with the device."""
        if device.type == "cuda":
            torch.cuda.synchronize()
        self._begin = time.perf_counter() - self.seconds

    def elapsed(self) -> float:
        """Return the training time [s] over all resumes, counted as for `TrainCfg.max_seconds`."""
        return self.seconds if self._begin is None else time.perf_counter() - self._begin

    def is_over_time(self) -> bool:
        """Return whether the training time has reached `max_seconds`."""
        return 0.0 < self.cfg.max_seconds <= self.elapsed()

    def progress(self, iteration: int) -> float:
        """Return the progress of the training, 0 to 1: the greater fraction of max_iterations and max_seconds."""
        of_time = self.elapsed() / self.cfg.max_seconds if self.cfg.max_seconds > 0.0 else 0.0
        return max(iteration / self.cfg.max_iterations, of_time)

    def remaining(self, iteration: int, seconds: float) -> float:
        """Return the estimated time to the end [s]; seconds: duration of an iteration [s]."""
        remaining = (self.cfg.max_iterations - iteration) * seconds
        if self.cfg.max_seconds > 0.0:
            remaining = min(remaining, max(self.cfg.max_seconds - self.elapsed(), 0.0))
        return remaining

    def limit(self, iteration: int) -> str:
        """Return the limit that ends the training after `iteration`, as a flag such as `--max-iterations 500`."""
        if iteration >= self.cfg.max_iterations:
            return f"--max-iterations {self.cfg.max_iterations}"
        return f"--max-seconds {self.cfg.max_seconds:g}"


def is_last_iteration(iteration: int, cfg: TrainCfg, end_early: bool) -> bool:
    """Return whether a run ends after `iteration` iterations; end_early: a stop request or the time limit."""
    return end_early or iteration >= cfg.max_iterations
