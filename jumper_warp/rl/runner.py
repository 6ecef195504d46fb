"""Training loop: one process per device, with logging, checkpoints, interruption by signal, and resuming."""

from __future__ import annotations

import json
import shlex
import sys
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from functools import partial
from pathlib import Path

import torch

from jumper_warp.envs.vec_env import VecEnv
from jumper_warp.rl import distributed, resume
from jumper_warp.rl.actor_init import ActorInit, apply_actor_init
from jumper_warp.rl.cfg import TrainCfg
from jumper_warp.rl.checkpoint import DECODE_ERRORS, Checkpoint, CheckpointError, one_line_message, save_checkpoint
from jumper_warp.rl.clock import TrainingClock, is_last_iteration
from jumper_warp.rl.distributed import Rank
from jumper_warp.rl.fused import make_ppo
from jumper_warp.rl.learner import STATISTICS
from jumper_warp.rl.logger import NoLog, Scores, Stopwatch, TrainingLog
from jumper_warp.rl.metrics_file import METRICS_FILE
from jumper_warp.rl.resume import CHECKPOINTS
from jumper_warp.rl.run_folder import (
    CONFIG,
    INTERRUPTED,
    AsRslRl,
    TrainResult,
    full_config,
    new_folder,
    report_non_finite,
    rescue_folder,
    write_config,
)
from jumper_warp.rl.stop_request import StopRequest
from jumper_warp.utils.errors import InputError
from jumper_warp.utils.locks import write_lock
from jumper_warp.utils.threads import set_threads

PERF = ("Perf/total_fps", "Perf/collection_time", "Perf/learning_time", "Perf/elapsed_s")
"""Performance metrics: policy steps per second, time of the rollout and of the update [s], training time [s]."""
LEARNING = ("Loss/learning_rate", "Policy/mean_std", "Train/mean_reward", "Train/mean_episode_length")
"""Learning metrics in addition to the losses; those of Train/ exist only if an episode has ended."""
WARM_UP = 5.0  # [s] A first iteration that takes longer measures the speed of a training on a CPU
MakeEnv = Callable[[int, int, torch.device], VecEnv]
"""Function that makes an environment from the number of worlds, the seed and the device."""


def train(
    cfg: TrainCfg, make_env: MakeEnv, command: str | None = None, as_rsl_rl: AsRslRl | None = None,
    actor_init: ActorInit | None = None, checkpoint: Checkpoint | None = None, expected_rate: float = 0.0,
) -> TrainResult:  # fmt: skip
    """Train a policy to the last iteration or the time limit, save a checkpoint, and return the result.

    command: command line printed for resuming, without `--resume` (default: `jumper train TASK`). as_rsl_rl: required
    by trainer rsl-rl. actor_init: initialisation from cfg.init_policy, required with it. checkpoint: the loaded
    checkpoint of cfg.resume (default: loaded here). expected_rate: usual environment steps per second of all worlds on
    two CPU cores; one line warns of less than half of it (0: no warning).
    Raises InputError: a setting does not fit the environment or the machine. CheckpointError: no usable checkpoint to
    resume from, or the last one could not be saved; InputError: another process is writing the run's folder.
    SystemExit, after a checkpoint was saved: with code INTERRUPTED if a signal stopped the training (`StopRequest`),
    with a message if a term was not finite and `stop_on_nan` is set, or if the run's folder was deleted.
    """
    set_threads(cfg.threads)
    rank = distributed.init_distributed(cfg.device, cfg.threads)
    with ExitStack() as cleanup:
        cleanup.callback(_leave_process_group)
        cfg.check_processes(rank.size)
        checkpoint = checkpoint or resume.find_checkpoint(cfg)
        if checkpoint is None and bool(cfg.init_policy) != (actor_init is not None):
            raise InputError("init_policy and actor_init, which is made from it, must be passed together")
        if checkpoint is not None and rank.index == 0:
            cleanup.enter_context(write_lock(checkpoint.path.parent.parent))
            resume.check_unchanged(checkpoint)
        env = make_env(cfg.num_envs // rank.size, (cfg.seed + 1000 * rank.index) % 2**31, rank.device)
        if cfg.trainer == "rsl-rl":
            if as_rsl_rl is None:
                raise InputError("trainer rsl-rl needs as_rsl_rl, which adapts the environment")
            from jumper_warp.rl.rsl_rl import run_rsl_rl

            return run_rsl_rl(cfg, env, as_rsl_rl, rank)
        torch.manual_seed(cfg.seed)  # the same weights in all processes
        run = TrainingRun(cfg, env, rank, command, actor_init, checkpoint, expected_rate)
        cleanup.callback(run.ppo.close)
        if checkpoint is None and rank.index == 0:
            cleanup.enter_context(write_lock(run.folder))
        try:
            with StopRequest() as stop:
                result = run.iterate(stop)
        except Exception as error:
            if any((run.folder / CHECKPOINTS).glob("*.pt")):
                error.add_note(f"continue from the last checkpoint with: {run.resume_command}")
            raise
        distributed.wait_for_ranks()
        if run.failure:
            raise SystemExit(f"jumper: {run.failure}")  # printed by Python, which exits with status 1
        if stop.requested:
            raise SystemExit(INTERRUPTED)
        return result


def _leave_process_group() -> None:
    """Leave torch's process group, if this process is in one."""
    if torch.distributed.is_initialized():
        torch.distributed.destroy_process_group()


class TrainingRun:
    """State of a training in this process: algorithm, environment, folder, iteration, time."""

    def __init__(
        self, cfg: TrainCfg, env: VecEnv, rank: Rank, command: str | None = None, actor_init: ActorInit | None = None,
        checkpoint: Checkpoint | None = None, expected_rate: float = 0.0,
    ) -> None:  # fmt: skip
        """Build the algorithm, and load the checkpoint of cfg.resume, else apply `actor_init` if given.

        command, actor_init, checkpoint, expected_rate: as in `train`. Raises InputError or CheckpointError as `train`.
        """
        self.cfg, self.env, self.rank = cfg, env, rank
        self._command, self._expected_rate = command or f"jumper train {cfg.task}", expected_rate
        self.ppo = make_ppo(env, cfg.ppo)
        losses = {f"Loss/{name}" for name in STATISTICS}
        logged = {*env.metrics(), *losses, *LEARNING, *PERF}
        if cfg.best_metric not in logged:
            examples = ", ".join(sorted(name for name in logged if name.startswith(("Metrics/", "Train/"))))
            raise InputError(f"best_metric must name a logged metric, such as {examples}, got {cfg.best_metric!r:.60}")
        self.config = full_config(cfg, env, rank)
        self.iteration = 0
        self.clock = TrainingClock(cfg)
        self._is_timed = rank.device.type == "cuda"  # whether the speed has been printed; a GPU's log comes soon
        self.metrics: dict[str, float] = {}
        self._scores = Scores(cfg.best_metric)
        self.notes: list[str] = []
        self.failure = ""  # Reason why the training ends with exit status 1; empty: none
        checkpoint = checkpoint or resume.find_checkpoint(cfg)
        if not distributed.same_on_all_ranks(str(checkpoint and (checkpoint.path, checkpoint.state["iteration"]))):
            raise InputError("the processes found different checkpoints: log_root must be a folder shared by all")
        if actor_init is not None and checkpoint is None:
            apply_actor_init(actor_init, self.ppo.model, cfg.num_envs * cfg.ppo.num_steps)
            self.notes.append(", ".join(filter(None, (f"starts from {cfg.init_policy}", actor_init.change))))
        torch.manual_seed(cfg.seed + 1 + rank.index)
        self.folder = new_folder(cfg, rank) if checkpoint is None else self._resume(checkpoint)
        if rank.index == 0:
            write_config(self.folder, self.config)

    def _resume(self, checkpoint: Checkpoint) -> Path:
        """Restore networks, environment and random generators from a checkpoint; return its run's folder.

        Raises CheckpointError: it does not fit the settings.
        """
        path, state, skipped, _ = checkpoint
        changed = resume.changed_settings(state, self.config)
        lines = [f"{name} {change}" for name, change in changed.items()]
        self.notes += [*(f"skipped: {reason}" for reason in skipped), f"resumed {path}", *lines]
        self.notes += resume.changed_user_files(state, self.config)
        try:
            resume.check_changes(changed, self.config)
            local = resume.rank_state(state, self.rank)
            self.ppo.load_state_dict({**state["ppo"], **local["ppo"]})
            self.env.load_state_dict(local["env"])
            self.clock.seconds = resume.saved_seconds(state)
            resume.set_random_state(local["rng"])
        except DECODE_ERRORS as error:
            suffix = f" ({', '.join(lines)})" if lines else ""
            raise CheckpointError(f"{path}: does not fit these settings: {one_line_message(error)}{suffix}") from error
        if "ppo.lr" in changed:
            self.ppo.lr.fill_(self.cfg.ppo.lr)
        self.iteration = state["iteration"]
        self.config["train"]["init_policy"] = resume.saved_init_policy(state)
        return path.parent.parent

    def iterate(self, stop: StopRequest) -> TrainResult:
        """Train until the last iteration, the time limit or a stop request, with logging and checkpoints."""
        cfg, ppo = self.cfg, self.ppo
        with ThreadPoolExecutor(1) as pool:
            kernels = pool.submit(getattr(self.env, "compile", lambda: None))  # optional for a `VecEnv`
            distributed.local_rank_zero_first(ppo.compile)
            kernels.result()
        if self.iteration == 0:
            self.env.reset()
        start, first_iteration = time.perf_counter(), self.iteration + 1
        watch = Stopwatch(self.rank.device)
        with self._open_log() as log:
            for note in [f"run {self.folder}", *self.notes]:
                log.print_line(note)
            is_last = is_last_iteration(self.iteration, cfg, self.clock.is_over_time())
            if is_last:
                complete = f"the training is complete at iteration {self.iteration}"
                log.print_line(f"{complete}: raise {self.clock.limit(self.iteration)} to continue")
            while not is_last:
                watch.start()
                ppo.set_progress(self.clock.progress(self.iteration))
                ppo.iterate(partial(self._mark, watch, log))
                stop.can_abort = False
                self.iteration += 1
                if self.iteration == first_iteration:
                    self.clock.start(self.rank.device)
                is_last = is_last_iteration(self.iteration, cfg, self.sync_stop_request(stop))
                saves = self.iteration % cfg.save_interval == 0
                logs = saves or self.iteration % cfg.log_interval == 0  # a checkpoint's score is of its last iterations
                if is_last or logs or saves or cfg.stop_on_nan:
                    self._check(log)
                    is_last = is_last or bool(self.failure and self.rank.size == 1)
                if is_last or logs:
                    (times, seconds), self._is_timed = watch.read(), True
                    self.metrics = self._read_metrics(times)
                    self._scores.add(self.metrics)
                    log.log(self.iteration, self.metrics, self.clock.remaining(self.iteration, seconds))
                elif self.iteration == first_iteration or not self._is_timed:
                    self._print_speed(log, watch, self.iteration == first_iteration)
                if is_last and not self.failure:
                    log.print_line(f"ended by {self._reason(stop)}")
                if is_last or saves:
                    self._save(log, is_last, stop)
                stop.can_abort = True
        return TrainResult(self.folder, self.iteration, time.perf_counter() - start, self.metrics)

    def _open_log(self) -> TrainingLog | NoLog:
        """Return a `TrainingLog` on rank 0, and a log that discards everything on other ranks."""
        if self.rank.index != 0:
            return NoLog()
        cfg = self.cfg
        outputs = (cfg.max_iterations, self._steps(), cfg.tensorboard, cfg.wandb)
        return TrainingLog(self.folder, self.config, *outputs, self.iteration, self._expected_rate)

    def _steps(self) -> int:
        """Return the number of environment steps in an iteration, of all worlds."""
        return self.cfg.ppo.num_steps * self.cfg.num_envs

    def _reason(self, stop: StopRequest) -> str:
        """Return a text about why the training ends, with the steps made if they are not all."""
        done, total = (count * self._steps() / 1.0e6 for count in (self.iteration, self.cfg.max_iterations))
        steps = f" after {done:.2f} M of {total:.2f} M steps" if done < total else ""
        return f"{'an interruption' if stop.requested else self.clock.limit(self.iteration)}{steps}"

    def _mark(self, watch: Stopwatch, log: TrainingLog | NoLog) -> None:
        """Mark the end of a part of an iteration for timing; warn of a low step rate in a long first iteration."""
        watch.mark()
        if not self.clock.started and (seconds := watch.lap_time()) > WARM_UP:
            log.check_rate(self._steps() / seconds)

    def _print_speed(self, log: TrainingLog | NoLog, watch: Stopwatch, is_first: bool) -> None:
        """Print a CPU's training speed; the first iteration counts only if it takes much longer than warm-up."""
        times, seconds = watch.read()
        if not self._is_timed and (seconds > WARM_UP or not is_first):
            log.print_speed(self._steps() / sum(times), self.clock.remaining(self.iteration, seconds))
            self._is_timed = True

    def _check(self, log: TrainingLog | NoLog) -> None:
        """Report NaN and infinite terms; set `failure` if one of them or a deleted run folder ends the training."""
        folder, print_line = self.folder, partial(print, file=sys.stderr)
        if isinstance(log, TrainingLog):
            print_line = log.print_line
            self.folder, failure = rescue_folder(folder, self.config, (CONFIG, METRICS_FILE))
            self.failure = self.failure or failure
            if self.folder != folder:
                log.move(self.folder)
        found = report_non_finite(self.env, self.folder, self.config, self.iteration, print_line, self.rank.index)
        if found and self.cfg.stop_on_nan:
            self.failure = self.failure or f"--stop-on-nan: {found[0]}"

    def sync_stop_request(self, stop: StopRequest) -> bool:
        """Return whether to end the training: a process has a stop request, a failure, or reached the time limit.

        Several processes synchronise this, `stop.requested` and `failure` only in logged iterations.
        """
        over_time = self.clock.is_over_time()
        failed = bool(self.failure)
        if distributed.world_size() > 1:
            if self.iteration % self.cfg.log_interval:
                return False
            flags = distributed.all_reduce_max([int(stop.requested), int(over_time), int(failed)])
            stop.requested, over_time, failed = map(bool, flags)
            self.failure = self.failure or ("another process has failed" if failed else "")
        return stop.requested or over_time or failed

    def _read_metrics(self, times: list[float]) -> dict[str, float]:
        """Return the metrics to log; times: of rollout and update [s], as in PERF."""
        perf = (self._steps() / sum(times), *times, self.clock.elapsed())
        return {**self.ppo.statistics(), **self.env.metrics(), **dict(zip(PERF, perf, strict=True))}

    def _save(self, log: TrainingLog | NoLog, is_last: bool, stop: StopRequest) -> None:
        """Save a checkpoint on rank 0; on failure print a warning, or raise CheckpointError if it is the last one.

        It also holds the states of the other ranks' environments, so that a resumed training continues identically.
        """
        seconds = self.clock.elapsed()
        local = {"ppo": self.ppo.state_dict(), "env": self.env.state_dict(), "rng": resume.random_state()}
        others = distributed.other_states(local, self.rank)
        if self.rank.index != 0:
            return
        state = {"iteration": self.iteration, "seconds": seconds, **local, "others": others}
        state["config"] = json.dumps(self.config)
        folder = self.folder / CHECKPOINTS
        try:
            path = save_checkpoint(folder, state, self._scores.mean(), self.cfg.max_checkpoints)
        except OSError as error:
            if is_last:
                raise CheckpointError(f"{folder}: checkpoint not saved: {error.strerror}") from error
            log.print_line(f"{folder}: checkpoint not saved, retried later: {error.strerror}")
            return
        self._scores.clear()
        if is_last:
            hint = f", continue with: {self.resume_command}"
            log.print_line(f"saved {path}{hint if stop.requested or self.failure else ''}")

    @property
    def resume_command(self) -> str:
        """Command line that resumes this run."""
        return f"{self._command} --resume {shlex.quote(str(self.folder))}"
