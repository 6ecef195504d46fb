"""Training of several seeds of the same settings side by side in one process.

Each seed has an environment, a learner, a log and a folder of its own, as in a single training. On a GPU its work is
enqueued on a stream of its own, so that the small kernels of several seeds run at the same time. Nothing is shared:
the results of a seed are bitwise those of a single training with this seed.
"""

from __future__ import annotations

import dataclasses
import math
import statistics
from collections.abc import Sequence
from contextlib import ExitStack, suppress
from pathlib import Path

import torch

from jumper_warp.rl import resume
from jumper_warp.rl.actor_init import ActorInit
from jumper_warp.rl.cfg import TrainCfg
from jumper_warp.rl.checkpoint import Checkpoint
from jumper_warp.rl.distributed import Rank
from jumper_warp.rl.logger import SeedsConsole
from jumper_warp.rl.run_folder import TrainResult, new_folder
from jumper_warp.rl.run_names import SEED
from jumper_warp.rl.runner import MakeEnv, Observer, finish, iterate, leave_process_group, lock, prepare
from jumper_warp.rl.training_run import TrainingRun
from jumper_warp.utils.errors import InputError
from jumper_warp.utils.locks import write_lock
from jumper_warp.utils.metrics import mean
from jumper_warp.utils.runtime import DeviceStream


def train(
    cfg: TrainCfg, make_env: MakeEnv, command: str | None = None, actor_init: ActorInit | None = None,
    checkpoints: Sequence[Checkpoint] = (), observers: Sequence[Observer] = (),
) -> TrainResult:  # fmt: skip
    """Train a policy of each seed in cfg.seeds, save their checkpoints, and return the results.

    Under torchrun every process trains a part of the seeds, without the others. A seed whose training fails, since its
    weights are not finite, or a term with `stop_on_nan`, is frozen: the others continue, and a resume omits it.
    checkpoints: one of each seed to continue from (default: those that cfg.resume selects). Other arguments and errors:
    see `jumper_warp.rl.runner.train`; a failure raises SystemExit if all seeds failed, except under torchrun.
    """
    with ExitStack() as cleanup:
        rank, checkpoints = prepare(cfg, actor_init, checkpoints, cleanup)
        resumed = _by_seed(cfg, checkpoints)
        first = next(iter(resumed.values()), None)
        folder = new_folder(cfg, rank) if first is None else first.path.parents[2]
        leave_process_group()
        seeds = (list(resumed) or list(cfg.seeds))[rank.index :: rank.size]
        if not seeds:
            raise InputError(f"{rank.size} processes need as many seeds; the run has {len(resumed)} to continue")
        console = SeedsConsole(cfg, quiet=rank.index > 0)
        cleanup.enter_context(console)
        console.print_line(f"run {folder}")
        device = Rank(0, 1, rank.device)
        runs = [_run(cfg, seed, make_env, device, folder, resumed.get(seed), console, cleanup, command, actor_init)
                for seed in seeds]  # fmt: skip
        frozen: set[int] = set()

        def after_iteration() -> None:
            """Show the metrics of all seeds, and report those that failed."""
            console.flush()
            for run in runs:
                if run.failure and run.ended and run.cfg.seed not in frozen:
                    frozen.add(run.cfg.seed)
                    run.log.print_line(f"frozen at iteration {run.iteration}: {run.failure}")
                    with suppress(OSError):
                        (run.folder / resume.FROZEN).write_text(f"iteration {run.iteration}: {run.failure}\n")

        stop = iterate(runs, after_iteration, observers)
        results = {run.cfg.seed: run.result() for run in runs}
        hint = f", continue with: {runs[0].resume_command}" if stop.requested else ""
        lines = [f"ended by {runs[0].reason(stop)}, saved in {folder}{hint}", *table(results, cfg.best_metric)]
        for line in lines:
            console.print_line(line)
        failing = runs if rank.size == 1 else []  # an exit status of 1 would end the processes of the other seeds
        return finish(_total(folder, results), failing, stop)


def _by_seed(cfg: TrainCfg, checkpoints: Sequence[Checkpoint]) -> dict[int, Checkpoint]:
    """Return checkpoints by seed. Raises InputError: a seed is not in cfg.seeds, or they are of a single training."""
    names = [checkpoint.path.parents[1].name for checkpoint in checkpoints]
    found = {int(name.removeprefix(SEED)) for name in names if name.startswith(SEED)}
    if len(found) < len(names) or not found <= set(cfg.seeds):
        run = f"seeds {', '.join(map(str, sorted(found)))}" if found else "one seed"
        raise InputError(f"the run to continue has {run}, got seeds {', '.join(map(str, cfg.seeds))}")
    return {int(name.removeprefix(SEED)): checkpoint for name, checkpoint in zip(names, checkpoints, strict=True)}


def _run(
    cfg: TrainCfg, seed: int, make_env: MakeEnv, rank: Rank, folder: Path, checkpoint: Checkpoint | None,
    console: SeedsConsole, cleanup: ExitStack, command: str | None, actor_init: ActorInit | None,
) -> TrainingRun:  # fmt: skip
    """Return the training of one seed, with its folder locked until `cleanup` ends; arguments: see `train`."""
    if checkpoint is not None:
        lock(checkpoint, cleanup)
    own = dataclasses.replace(cfg, seed=seed, seeds=())
    stream = DeviceStream(rank.device)
    with stream:
        env = make_env(cfg.num_envs, seed, rank.device)
        torch.manual_seed(seed)
        run = TrainingRun(
            own, env, rank, command, actor_init, checkpoint, folder=folder / f"{SEED}{seed}",
            console=console.of_seed(seed), stream=stream,
        )  # fmt: skip
    cleanup.callback(run.ppo.close)
    if checkpoint is None:
        cleanup.enter_context(write_lock(run.folder))
    return run


def _total(folder: Path, results: dict[int, TrainResult]) -> TrainResult:
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
