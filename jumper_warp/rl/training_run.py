"""State of one training in a process: iterations, logging, checkpoints and resuming."""

from __future__ import annotations

import json
import shlex
import sys
import time
from collections.abc import Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import AbstractContextManager, contextmanager, suppress
from functools import partial
from pathlib import Path

from jumper_warp.envs.vec_env import VecEnv
from jumper_warp.rl import distributed, run_folder
from jumper_warp.rl.actor_init import ActorInit, apply_actor_init
from jumper_warp.rl.cfg import TrainCfg
from jumper_warp.rl.checkpoint import (
    DECODE_ERRORS,
    Checkpoint,
    CheckpointError,
    on_cpu,
    one_line_message,
    save_checkpoint,
)
from jumper_warp.rl.clock import TrainingClock, is_last_iteration
from jumper_warp.rl.distributed import Rank
from jumper_warp.rl.fused import make_ppo
from jumper_warp.rl.learner import STATISTICS
from jumper_warp.rl.logger import NoLog, Scores, Stopwatch, TrainingConsole, TrainingLog
from jumper_warp.rl.run_folder import CONFIG, TrainResult
from jumper_warp.rl.run_names import CHECKPOINTS, FROZEN, SEED
from jumper_warp.rl.stop_request import StopRequest
from jumper_warp.utils.errors import InputError
from jumper_warp.utils.files import Json
from jumper_warp.utils.sources import changed_sources

PERF = ("Perf/total_fps", "Perf/collection_time", "Perf/learning_time", "Perf/elapsed_s")
"""Performance metrics: policy steps per second, time of the rollout and of the update [s], training time [s]."""
LEARNING = ("Loss/learning_rate", "Policy/mean_std", "Train/mean_reward", "Train/mean_episode_length")
"""Learning metrics in addition to the losses; those of Train/ exist only if an episode has ended."""


class TrainingRun:
    """State of a training in this process: algorithm, environment, folder, iteration, time."""

    def __init__(
        self, cfg: TrainCfg, env: VecEnv, rank: Rank, console: TrainingConsole, stream: AbstractContextManager,
        command: str | None = None, actor_init: ActorInit | None = None, checkpoint: Checkpoint | None = None,
        folder: Path | None = None,
    ) -> None:  # fmt: skip
        """Build the algorithm, and load the checkpoint, else apply `actor_init` if given.

        console: shows lines and progress. stream: context in which all work of the run is enqueued. command,
        actor_init, checkpoint: as in `train`. folder: of one of several seeds (default: a new one, by time). Raises
        InputError or CheckpointError as `train`.
        """
        self.cfg, self.env, self.rank = cfg, env, rank
        self._command = command or f"jumper train {cfg.task}"
        self.stream, self._console, self._is_single = stream, console, folder is None
        self.ppo = make_ppo(env, cfg.ppo)
        losses = {f"Loss/{name}" for name in STATISTICS}
        self._logged = {*env.metrics(), *losses, *LEARNING, *PERF}  # Names of the logged metrics
        self.check_logged("best_metric", cfg.best_metric)
        self.config = run_folder.full_config(cfg, env, rank)
        self.iteration = 0
        self.ended = False
        self.clock = TrainingClock(cfg)
        self.metrics: dict[str, float] = {}
        self._scores = Scores(cfg.best_metric)
        self._saving: Future[Path] | None = None  # writes a checkpoint while the training continues
        self.notes: list[str] = []
        self.failure = ""  # Reason why the training ends with exit status 1; empty: none
        self._is_finite = True  # Whether the weights are finite, else they are not saved
        if not distributed.same_on_all_ranks(str(checkpoint and (checkpoint.path, checkpoint.state["iteration"]))):
            raise InputError("the processes found different checkpoints: log_root must be a folder shared by all")
        if actor_init is not None and checkpoint is None:
            apply_actor_init(actor_init, self.ppo.model, cfg.num_envs * cfg.ppo.num_steps)
            self.notes.append(", ".join(filter(None, (f"starts from {cfg.init_policy}", actor_init.change))))
        self.ppo.generator.manual_seed(cfg.seed + 1 + rank.index)
        if checkpoint is not None:
            self.folder = self._resume(checkpoint)
        elif folder is not None:
            self.folder = folder
            folder.mkdir(parents=True)
        else:
            self.folder = run_folder.new_folder(cfg, rank)
        if self._is_single:
            self.notes.insert(0, f"run {self.folder}")
        if rank.index == 0:
            run_folder.write_config(self.folder, self.config)

    def check_logged(self, name: str, metric: str) -> None:
        """Raise InputError, which begins with `name`, unless this training logs a metric."""
        if metric not in self._logged:
            examples = ", ".join(sorted(each for each in self._logged if each.startswith(("Metrics/", "Train/"))))
            raise InputError(f"{name} must name a logged metric, such as {examples}, got {metric!r:.60}")

    def _resume(self, checkpoint: Checkpoint) -> Path:
        """Restore networks, environment and random generators from a checkpoint; return its run's folder.

        Raises CheckpointError: it does not fit the settings.
        """
        path, state, skipped, _ = checkpoint
        lines: list[str] = []
        try:
            saved = json.loads(state["config"])
            changed = run_folder.changed_settings(saved, self.config)
            lines = [f"{name} {change}" for name, change in changed.items()]
            run_folder.check_changes(changed, self.config)
            sources = changed_sources(saved["sources"], self.config["sources"])
            self.config["train"]["init_policy"] = saved["train"]["init_policy"]
            ranks = [state, *state["others"]]
            if len(ranks) != self.rank.size:
                raise InputError(f"saved by {len(ranks)} processes, resumed by {self.rank.size}")
            local = ranks[self.rank.index]
            self.ppo.set_random_state(local["rng"])
            self.ppo.load_state_dict({**state["ppo"], **local["ppo"]})
            self.env.load_state_dict(local["env"])
            self.clock.seconds = float(state.get("seconds", 0.0))
        except DECODE_ERRORS as error:
            suffix = f" ({', '.join(lines)})" if lines else ""
            raise CheckpointError(f"{path}: does not fit these settings: {one_line_message(error)}{suffix}") from error
        self.notes += [*(f"skipped: {reason}" for reason in skipped), f"resumed {path}", *lines, *sources]
        if "ppo.lr" in changed:
            self.ppo.lr.fill_(self.cfg.ppo.lr)
        self.iteration = state["iteration"]
        return path.parent.parent

    @contextmanager
    def open(self) -> Iterator[None]:
        """Context in which the training can iterate: kernels are compiled, the log is open."""
        with self.stream, ThreadPoolExecutor(1) as pool:
            kernels = pool.submit(getattr(self.env, "compile", lambda: None))  # optional for a `VecEnv`
            distributed.local_rank_zero_first(self.ppo.compile)
            kernels.result()
            if self.iteration == 0:
                self.env.reset()
        self._begin, self._first_iteration = time.perf_counter(), self.iteration + 1
        self._seconds = 0.0
        self._watch = Stopwatch(self.rank.device)
        with self._open_log() as self.log, ThreadPoolExecutor(1) as self._saver:
            for note in self.notes:
                self.log.print_line(note)
            self.ended = is_last_iteration(self.iteration, self.cfg, self.clock.is_over_time())
            if self.ended:
                complete = f"the training is complete at iteration {self.iteration}"
                self.log.print_line(f"{complete}: raise {self.clock.limit(self.iteration)} to continue")
            yield
            self._finish_saving()

    def collect(self) -> None:
        """Enqueue the rollout of an iteration on the device."""
        self._watch.start()
        self.ppo.set_progress(self.clock.progress(self.iteration))
        self.ppo.collect()
        self._watch.mark()

    def update(self) -> None:
        """Enqueue the update of an iteration on the device."""
        self.ppo.update()
        self._watch.mark()

    def conclude(self, stop: StopRequest, ends: bool) -> None:
        """Count the iteration that was enqueued; log and save it where it is due. ends: whether it is the last one."""
        cfg, log, watch = self.cfg, self.log, self._watch
        self.iteration += 1
        if self.iteration == self._first_iteration:
            self.clock.start(self.rank.device)
        is_last = is_last_iteration(self.iteration, cfg, ends)
        saves = self.iteration % cfg.save_interval == 0
        logs = saves or self.iteration % cfg.log_interval == 0  # a checkpoint's score is of its last iterations
        if is_last or logs or saves or cfg.stop_on_nan:
            self._check()
            is_last = is_last or bool(self.failure and self.rank.size == 1)
        if is_last or logs:
            times, seconds = watch.read()
            self.metrics = self._read_metrics(times)
            self._scores.add(self.metrics)
            log.log(self.iteration, self.metrics, self.clock.remaining(self.iteration, seconds))
            if self._is_single:
                self._console.flush()
        elif self.iteration == self._first_iteration:
            watch.read()  # the rate in the log leaves the warm-up out
        if is_last and self.failure and not self._is_single:
            log.print_line(f"frozen at iteration {self.iteration}: {self.failure}")
            with suppress(OSError):
                (self.folder / FROZEN).write_text(f"iteration {self.iteration}: {self.failure}\n")
        elif is_last and not self.failure and self._is_single:
            log.print_line(f"ended by {self.reason(stop)}")
        if (is_last or saves) and self._is_finite:
            self._save(is_last, stop)
        self._seconds = time.perf_counter() - self._begin
        self.ended = is_last

    def result(self) -> TrainResult:
        """Return the training's result so far."""
        return TrainResult(self.folder, self.iteration, self._seconds, self.metrics, {})

    def _open_log(self) -> TrainingLog | NoLog:
        """Return a `TrainingLog` on rank 0, and a log that discards everything on other ranks."""
        if self.rank.index != 0:
            return NoLog()
        return TrainingLog(self.folder, self.config, self.cfg, self._console, self.iteration)

    def _steps(self) -> int:
        """Return the number of environment steps in an iteration, of all worlds."""
        return self.cfg.ppo.num_steps * self.cfg.num_envs

    def reason(self, stop: StopRequest) -> str:
        """Return a text about why the training ends, with the steps made if they are not all."""
        done, total = (count * self._steps() / 1.0e6 for count in (self.iteration, self.cfg.max_iterations))
        end = "an interruption" if stop.requested else "a failure" if self.failure else self.clock.limit(self.iteration)
        return f"{end} after {done:.2f} M of {total:.2f} M steps" if done < total else end

    def _check(self) -> None:
        """Report NaN and infinite terms; set `failure` if one or the weights end the training."""
        print_line = self.log.print_line if self.rank.index == 0 else partial(print, file=sys.stderr)
        self._is_finite = self.ppo.is_finite()
        if not self._is_finite:
            self.failure = self.failure or "the weights are not finite; the last checkpoint is the one before"
        found = run_folder.report_non_finite(
            self.env, self.folder, self.config, self.iteration, print_line, self.rank.index
        )
        if found and self.cfg.stop_on_nan:
            self.failure = self.failure or f"--stop-on-nan: {found[0]}"

    def is_end_requested(self, stop: StopRequest) -> bool:
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

    def _save(self, is_last: bool, stop: StopRequest) -> None:
        """Save a checkpoint on rank 0 while the training continues; if it is the last one, wait for it.

        It also holds the states of the other ranks' environments, so that a resumed training continues identically.
        Raises CheckpointError: the last one cannot be saved.
        """
        seconds = self.clock.elapsed()
        local = {"ppo": on_cpu(self.ppo.state_dict()), "env": self.env.state_dict(), "rng": self.ppo.random_state()}
        others = distributed.other_states(local, self.rank)
        if self.rank.index != 0:
            return
        state = {"iteration": self.iteration, "seconds": seconds, **local, "others": others}
        state["config"] = json.dumps(self.config)
        self._finish_saving()
        self._saving = self._saver.submit(self._write, state, self._scores.mean())
        self._scores.clear()
        if is_last and (path := self._finish_saving(is_last)) and self._is_single:
            hint = f", continue with: {self.resume_command}"
            self.log.print_line(f"saved {path}{hint if stop.requested or self.failure else ''}")

    def _write(self, state: Json, score: float | None) -> Path:
        """Write a checkpoint and return its path. Raises OSError as `save_checkpoint`."""
        if not (self.folder / CONFIG).is_file():  # the run's folder was deleted
            self.folder.mkdir(parents=True, exist_ok=True)
            run_folder.write_config(self.folder, self.config)
        return save_checkpoint(self.folder / CHECKPOINTS, state, score, self.cfg.max_checkpoints)

    def _finish_saving(self, is_last: bool = False) -> Path | None:
        """Wait until the checkpoint that is being written is complete, and return its path; None if there is none.

        If it failed, print a warning, or raise CheckpointError if it is the last one.
        """
        saving, self._saving = self._saving, None
        try:
            return saving and saving.result()
        except OSError as error:
            message = f"{self.folder / CHECKPOINTS}: checkpoint not saved"
            if is_last:
                raise CheckpointError(f"{message}: {error.strerror}") from error
            self.log.print_line(f"{message}, retried later: {error.strerror}")
            return None

    @property
    def resume_command(self) -> str:
        """Command line that resumes this run, with all its seeds."""
        folder = self.folder.parent if self.folder.name.startswith(SEED) else self.folder
        return f"{self._command} --resume {shlex.quote(str(folder))}"
