"""Training loop of one run, or of several side by side; one process per device, interruption by signal."""

from __future__ import annotations

import dataclasses
import math
import statistics
from collections.abc import Callable, Sequence
from contextlib import ExitStack, nullcontext
from pathlib import Path
from typing import Protocol

import torch

from jumper_warp.envs.vec_env import VecEnv
from jumper_warp.rl import distributed
from jumper_warp.rl.actor_init import ActorInit
from jumper_warp.rl.cfg import TrainCfg
from jumper_warp.rl.checkpoint import Checkpoint, check_unchanged, find_checkpoints
from jumper_warp.rl.distributed import Rank
from jumper_warp.rl.logger import TrainingConsole
from jumper_warp.rl.run_folder import INTERRUPTED, TrainResult, new_folder
from jumper_warp.rl.run_names import CHECKPOINTS, SEED
from jumper_warp.rl.stop_request import StopRequest
from jumper_warp.rl.training_run import TrainingRun
from jumper_warp.utils.errors import InputError
from jumper_warp.utils.locks import write_lock
from jumper_warp.utils.metrics import mean
from jumper_warp.utils.runtime import DeviceStream
from jumper_warp.utils.threads import set_threads


class Observer(Protocol):
    """Observer of trainings that run side by side, which it must not change; subclasses inherit empty methods."""

    def begin(self, runs: Sequence[TrainingRun]) -> None:
        """Prepare to observe runs, after their kernels are compiled and before their next iteration."""

    def after_iteration(self, runs: Sequence[TrainingRun]) -> None:
        """Observe runs after each iteration, without waiting for the device. An exception ends the trainings."""

    def end(self) -> None:
        """Finish after the last iteration, or an error."""


MakeEnv = Callable[[int, int, torch.device], VecEnv]
"""Function that makes an environment from the number of worlds, the seed and the device."""


def train(
    cfg: TrainCfg, make_env: MakeEnv, command: str | None = None, actor_init: ActorInit | None = None,
    checkpoints: Sequence[Checkpoint] = (), observers: Sequence[Observer] = (),
) -> TrainResult:  # fmt: skip
    """Train a policy, or one of each seed in cfg.seeds, to the last iteration or the time limit, and return the result.

    Each seed has an environment, a learner, a log and a folder of its own, as in a single training. On a GPU its work
    is enqueued on a stream of its own, so that the small kernels of several seeds run at the same time. Nothing is
    shared: the results of a seed are bitwise those of a single training with this seed. A seed whose training fails,
    since its weights are not finite, or a term with `stop_on_nan`, is frozen: the others continue, and a resume omits
    it. Under torchrun every process trains a part of the seeds, without the others.

    command: command line printed for resuming, without `--resume` (default: `jumper train TASK`). actor_init:
    initialisation from cfg.init_policy, required with it. checkpoints: one, or one of each seed, to continue from
    (default: those that cfg.resume selects). observers: of the training.
    Raises InputError: a setting does not fit the environment or the machine. CheckpointError: no usable checkpoint to
    resume from, or the last one could not be saved; InputError: another process is writing the run's folder.
    SystemExit, after a checkpoint was saved: with code INTERRUPTED if a signal stopped the training (`StopRequest`),
    with a message if a term was not finite and `stop_on_nan` is set, or weights are not finite; of several seeds, if
    all failed, except under torchrun.
    """
    with ExitStack() as cleanup:
        set_threads(cfg.threads)
        rank = distributed.init_distributed(cfg.device, cfg.threads)
        cleanup.callback(leave_process_group)
        cfg.check_processes(rank.size)
        checkpoints = checkpoints or find_checkpoints(cfg)
        if not checkpoints and bool(cfg.init_policy) != (actor_init is not None):
            raise InputError("init_policy and actor_init, which is made from it, must be passed together")
        console = TrainingConsole(cfg, quiet=rank.index > 0)
        cleanup.enter_context(console)
        trainings, folder, each = [(cfg, checkpoints[0] if checkpoints else None)], None, rank
        if cfg.seeds:
            trainings = trainings_of_seeds(cfg, checkpoints)
            folder = checkpoints[0].path.parents[2] if checkpoints else new_folder(cfg, rank)
            leave_process_group()
            each = Rank(0, 1, rank.device)
            if rank.size > len(trainings):
                raise InputError(f"{rank.size} processes need as many seeds; the run has {len(trainings)} to continue")
            trainings = trainings[rank.index :: rank.size]
            console.print_line(f"run {folder}")

        def prepare(cfg: TrainCfg, checkpoint: Checkpoint | None) -> TrainingRun:
            """Return a training, with its folder locked until the end."""
            if checkpoint is not None and each.index == 0:
                cleanup.enter_context(write_lock(checkpoint.path.parent.parent))
                check_unchanged(checkpoint)
            stream = DeviceStream(each.device) if folder else nullcontext()
            with stream:
                env = make_env(cfg.num_envs // each.size, (cfg.seed + 1000 * each.index) % 2**31, each.device)
                torch.manual_seed(cfg.seed)  # the same weights in all processes
                own = folder / f"{SEED}{cfg.seed}" if folder else None
                run = TrainingRun(cfg, env, each, console, stream, command, actor_init, checkpoint, own)
            cleanup.callback(run.ppo.close)
            if checkpoint is None and each.index == 0:
                cleanup.enter_context(write_lock(run.folder))
            return run

        runs = [prepare(*training) for training in trainings]
        stop = iterate(runs, console, observers)
        distributed.wait_for_ranks()
        result, failing = runs[0].result(), runs
        if folder is not None:
            results = {run.cfg.seed: run.result() for run in runs}
            hint = f", continue with: {runs[0].resume_command}" if stop.requested else ""
            last = min(runs, key=lambda run: bool(run.failure))  # not a frozen one, unless all are
            console.print_line(f"ended by {last.reason(stop)}, saved in {folder}{hint}")
            for line in seeds_table(results, cfg.best_metric):
                console.print_line(line)
            result = total_result(folder, results)
            failing = runs if rank.size == 1 else []  # an exit status of 1 would end the processes of the other seeds
        if failing and all(run.failure for run in failing):
            raise SystemExit(f"jumper: {failing[0].failure}")  # printed by Python, which exits with status 1
        if stop.requested:
            raise SystemExit(INTERRUPTED)
        return result


def trainings_of_seeds(cfg: TrainCfg, checkpoints: Sequence[Checkpoint]) -> list[tuple[TrainCfg, Checkpoint | None]]:
    """Return the settings of each seed to train, with its checkpoint; if any has one, seeds without one are left out.

    Raises InputError: a seed is not in cfg.seeds, or the checkpoints are of a single training.
    """
    found = [checkpoint.seed for checkpoint in checkpoints if checkpoint.seed is not None]
    if len(found) < len(checkpoints) or not set(found) <= set(cfg.seeds):
        run = f"seeds {', '.join(map(str, sorted(found)))}" if found else "one seed"
        raise InputError(f"the run to continue has {run}, got seeds {', '.join(map(str, cfg.seeds))}")
    pairs = zip(found, checkpoints, strict=True) if found else ((seed, None) for seed in cfg.seeds)
    return [(dataclasses.replace(cfg, seed=seed, seeds=()), checkpoint) for seed, checkpoint in pairs]


def total_result(folder: Path, results: dict[int, TrainResult]) -> TrainResult:
    """Return the result of all seeds: the largest iteration and time, and the means of the metrics that all have."""
    values = list(results.values())
    names = sorted(set.intersection(*(set(result.metrics) for result in values)))
    means = {name: statistics.fmean(result.metrics[name] for result in values) for name in names}
    return TrainResult(folder, max(r.iteration for r in values), max(r.seconds for r in values), means, results)


def seeds_table(results: dict[int, TrainResult], metric: str) -> list[str]:
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


def iterate(runs: Sequence[TrainingRun], console: TrainingConsole, observers: Sequence[Observer] = ()) -> StopRequest:
    """Run trainings side by side, until the last iteration, the time limit or a stop request; return the latter.

    console: that the runs log to; it shows their metrics after each iteration. observers: of the trainings.
    """
    try:
        with StopRequest() as stop, ExitStack() as opened:
            for run in runs:
                opened.enter_context(run.open())
            for observer in observers:
                opened.callback(observer.end)
                observer.begin(runs)
            while active := [run for run in runs if not run.ended]:
                for part in (TrainingRun.collect, TrainingRun.update):  # the same kernels of all runs fill a GPU best
                    for run in active:
                        with run.stream:
                            part(run)
                stop.can_abort = False
                ends = [run.is_end_requested(stop) for run in active]
                for run in active:
                    with run.stream:
                        run.conclude(stop, any(ends))
                console.flush()
                for observer in observers:
                    observer.after_iteration(runs)
                stop.can_abort = True
            return stop
    except Exception as error:
        if any(any((run.folder / CHECKPOINTS).glob("*.pt")) for run in runs):
            error.add_note(f"continue from the last checkpoint with: {runs[0].resume_command}")
        raise


def leave_process_group() -> None:
    """Leave torch's process group, if this process is in one."""
    if torch.distributed.is_initialized():
        torch.distributed.destroy_process_group()
