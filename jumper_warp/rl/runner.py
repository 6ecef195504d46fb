"""Training loop of one run, or of several side by side; one process per device, interruption by signal."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import ExitStack
from typing import Protocol

import torch

from jumper_warp.envs.vec_env import VecEnv
from jumper_warp.rl import distributed, resume
from jumper_warp.rl.actor_init import ActorInit
from jumper_warp.rl.cfg import TrainCfg
from jumper_warp.rl.checkpoint import Checkpoint
from jumper_warp.rl.distributed import Rank
from jumper_warp.rl.run_folder import INTERRUPTED, TrainResult
from jumper_warp.rl.run_names import CHECKPOINTS
from jumper_warp.rl.stop_request import StopRequest
from jumper_warp.rl.training_run import TrainingRun
from jumper_warp.utils.errors import InputError
from jumper_warp.utils.locks import write_lock
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
    checkpoint: Checkpoint | None = None, observers: Sequence[Observer] = (),
) -> TrainResult:  # fmt: skip
    """Train a policy to the last iteration or the time limit, save a checkpoint, and return the result.

    command: command line printed for resuming, without `--resume` (default: `jumper train TASK`). actor_init:
    initialisation from cfg.init_policy, required with it. checkpoint: the loaded checkpoint of cfg.resume (default:
    loaded here). observers: of the training.
    Raises InputError: a setting does not fit the environment or the machine. CheckpointError: no usable checkpoint to
    resume from, or the last one could not be saved; InputError: another process is writing the run's folder.
    SystemExit, after a checkpoint was saved: with code INTERRUPTED if a signal stopped the training (`StopRequest`),
    with a message if a term was not finite and `stop_on_nan` is set; without one if weights are not finite.
    """
    with ExitStack() as cleanup:
        rank, checkpoints = prepare(cfg, actor_init, [checkpoint] if checkpoint else [], cleanup)
        checkpoint = checkpoints[0] if checkpoints else None
        if checkpoint is not None and rank.index == 0:
            lock(checkpoint, cleanup)
        env = make_env(cfg.num_envs // rank.size, (cfg.seed + 1000 * rank.index) % 2**31, rank.device)
        torch.manual_seed(cfg.seed)  # the same weights in all processes
        run = TrainingRun(cfg, env, rank, command, actor_init, checkpoint)
        cleanup.callback(run.ppo.close)
        if checkpoint is None and rank.index == 0:
            cleanup.enter_context(write_lock(run.folder))
        stop = iterate([run], observers=observers)
        distributed.wait_for_ranks()
        return finish(run.result(), [run], stop)


def prepare(
    cfg: TrainCfg, actor_init: ActorInit | None, checkpoints: Sequence[Checkpoint], cleanup: ExitStack
) -> tuple[Rank, Sequence[Checkpoint]]:
    """Set threads and device of this process, join its process group until `cleanup` ends, and find the checkpoints.

    Returned: the rank, and `checkpoints`, by default those that cfg.resume selects. Raises InputError: the settings do
    not fit, or init_policy and actor_init are not passed together. CheckpointError as `resume.find_checkpoints`.
    """
    set_threads(cfg.threads)
    rank = distributed.init_distributed(cfg.device, cfg.threads)
    cleanup.callback(leave_process_group)
    cfg.check_processes(rank.size)
    checkpoints = checkpoints or resume.find_checkpoints(cfg)
    if not checkpoints and bool(cfg.init_policy) != (actor_init is not None):
        raise InputError("init_policy and actor_init, which is made from it, must be passed together")
    return rank, checkpoints


def iterate(
    runs: Sequence[TrainingRun], on_logged: Callable[[], None] = lambda: None, observers: Sequence[Observer] = ()
) -> StopRequest:
    """Run trainings side by side, until the last iteration, the time limit or a stop request; return the latter.

    on_logged: called after each iteration. observers: of the trainings.
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
                on_logged()
                for observer in observers:
                    observer.after_iteration(runs)
                stop.can_abort = True
            return stop
    except Exception as error:
        if any(any((run.folder / CHECKPOINTS).glob("*.pt")) for run in runs):
            error.add_note(f"continue from the last checkpoint with: {runs[0].resume_command}")
        raise


def finish(result: TrainResult, runs: Sequence[TrainingRun], stop: StopRequest) -> TrainResult:
    """Return the result of trainings that ended. Raises SystemExit: all of `runs` failed, or a signal stopped them."""
    if runs and all(run.failure for run in runs):
        raise SystemExit(f"jumper: {runs[0].failure}")  # printed by Python, which exits with status 1
    if stop.requested:
        raise SystemExit(INTERRUPTED)
    return result


def lock(checkpoint: Checkpoint, cleanup: ExitStack) -> None:
    """Lock the folder of a run that is resumed from a checkpoint. Raises InputError or CheckpointError as `train`."""
    cleanup.enter_context(write_lock(checkpoint.path.parent.parent))
    resume.check_unchanged(checkpoint)


def leave_process_group() -> None:
    """Leave torch's process group, if this process is in one."""
    if torch.distributed.is_initialized():
        torch.distributed.destroy_process_group()
