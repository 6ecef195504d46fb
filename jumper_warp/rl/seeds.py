"""Checkpoints and results of several seeds of the same settings, trained side by side in one process."""

from __future__ import annotations

import dataclasses
import math
import statistics
from collections.abc import Sequence
from pathlib import Path

from jumper_warp.rl.cfg import TrainCfg
from jumper_warp.rl.checkpoint import Checkpoint
from jumper_warp.rl.run_folder import TrainResult
from jumper_warp.utils.errors import InputError
from jumper_warp.utils.metrics import mean


def trainings(cfg: TrainCfg, checkpoints: Sequence[Checkpoint]) -> list[tuple[TrainCfg, Checkpoint | None]]:
    """Return the settings of each seed to train, with its checkpoint; if any has one, seeds without one are left out.

    Raises InputError: a seed is not in cfg.seeds, or the checkpoints are of a single training.
    """
    found = [checkpoint.seed for checkpoint in checkpoints if checkpoint.seed is not None]
    if len(found) < len(checkpoints) or not set(found) <= set(cfg.seeds):
        run = f"seeds {', '.join(map(str, sorted(found)))}" if found else "one seed"
        raise InputError(f"the run to continue has {run}, got seeds {', '.join(map(str, cfg.seeds))}")
    pairs = zip(found, checkpoints, strict=True) if found else ((seed, None) for seed in cfg.seeds)
    return [(dataclasses.replace(cfg, seed=seed, seeds=()), checkpoint) for seed, checkpoint in pairs]


def total(folder: Path, results: dict[int, TrainResult]) -> TrainResult:
    """Return the result of all seeds: the largest iteration and time, and the means of the metrics that all have."""
    values = list(results.values())
    names = sorted(set.intersection(*(set(result.metrics) for result in values)))
    means = {name: statistics.fmean(result.metrics[name] for result in values) for name in names}
    return TrainResult(folder, max(r.iteration for r in values), max(r.seconds for r in values), means, results)


def table(results: dict[int, TrainResult], metric: str) -> list[str]:
    """Return lines with the last value of a metric and the mean reward of each seed, and their means over the seeds.

    In brackets: 95 % bootstrap interval of the mean.
    """
    lines = [f"seed   {metric.removeprefix('Metrics/'):>10}   reward   iteration"]
    for seed, result in results.items():
        numbers = (result.metrics.get(name, float("nan")) for name in (metric, "Train/mean_reward"))
        lines.append("{:<6} {:>10.3f} {:>8.2f} {:>11}".format(seed, *numbers, result.iteration))
    measured = mean([result.metrics.get(metric, math.nan) for result in results.values()])
    if len(results) > 1 and measured.interval is not None:
        lines.append("mean   {:>10.3f} [{:.3f}, {:.3f}]".format(measured.value, *measured.interval))
    return lines
