"""Training: one process per device, logged, interruptible at any time, and resumed where it was left."""

from __future__ import annotations

import dataclasses
import json
import shlex
import signal
import sys
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from datetime import datetime
from pathlib import Path
from types import FrameType
from typing import Any, NamedTuple, cast

import torch

from jumper_warp.envs.vec_env import DifferentiableVecEnv, VecEnv
from jumper_warp.rl.cfg import TrainCfg
from jumper_warp.rl.checkpoint import DAMAGE, Checkpoint, CheckpointError, one_line, save_checkpoint
from jumper_warp.rl.distributed import (
    Rank,
    all_same,
    gather,
    join_ranks,
    largest_over_ranks,
    one_rank_first,
    wait_for_ranks,
    world_size,
)
from jumper_warp.rl.logger import Stopwatch, TrainingLog
from jumper_warp.rl.ppo import STATISTICS, Ppo
from jumper_warp.rl.resume import (
    CHECKPOINTS,
    changed_files,
    changes,
    find_checkpoint,
    own_part,
    random_state,
    set_random_state,
    spent_seconds,
    started_from,
)
from jumper_warp.rl.shac import STATISTICS as SHAC_STATISTICS
from jumper_warp.rl.shac import Shac
from jumper_warp.rl.start import Start, begin_with
from jumper_warp.utils.errors import InputError
from jumper_warp.utils.files import write_whole
from jumper_warp.utils.runtime import git_commit, versions
from jumper_warp.utils.sources import source_sums
from jumper_warp.utils.threads import set_threads

CONFIG = "config.json"
"""File of a run: all settings, versions and the commit."""
PERF = ("Perf/fps", "Perf/collect_s", "Perf/update_s", "Perf/elapsed_s")
"""Logged figures of the training itself: steps per second, and seconds."""
LEARNING = ("Loss/learning_rate", "Policy/mean_std", "Train/mean_return", "Train/mean_length")
"""Logged besides the losses; those of Train/ once an episode has ended."""
INTERRUPTED = 130
"""Exit code of a training that was asked to stop."""

MakeEnv = Callable[[int, int, torch.device], VecEnv]
"""Makes an environment from the number of its worlds, a seed and a device."""
AsRslRl = Callable[[VecEnv, int], Any]
"""Makes rsl-rl's view of an environment, which reads its metrics once in so many steps."""


class TrainResult(NamedTuple):
    """What a finished training leaves."""

    folder: Path
    iteration: int
    """Iterations that the policy has had."""
    seconds: float
    """Wall-clock time of this process's iterations [s], the first one included."""
    figures: dict[str, float]
    """The last logged ones."""


class Stop:
    """Context in which Ctrl-C and SIGTERM set `asked`; the second Ctrl-C interrupts at once."""

    def __enter__(self) -> Stop:
        self.asked = False
        self._previous = {number: signal.signal(number, self._ask) for number in (signal.SIGINT, signal.SIGTERM)}
        return self

    def __exit__(self, *_: object) -> None:
        for number, handler in self._previous.items():
            signal.signal(number, handler)

    def _ask(self, number: int, frame: FrameType | None) -> None:
        self.asked = True
        signal.signal(signal.SIGINT, signal.default_int_handler)


def train(
    cfg: TrainCfg, make_env: MakeEnv, command: str | None = None, as_rsl_rl: AsRslRl | None = None,
    start: Start | None = None, checkpoint: Checkpoint | None = None,
) -> TrainResult:  # fmt: skip
    """Train to the last iteration or the time limit, and save.

    command: what the user would type to continue, without `--resume`; by default `jumper train TASK`. as_rsl_rl: needed
    with trainer rsl-rl. start: the policy that cfg.start_from names, needed with it. checkpoint: the one that
    cfg.resume names, if it has been read.

    Raises ValueError: a setting does not fit the environment or the machine. CheckpointError: there is nothing usable
    to resume from, or the end could not be saved. SystemExit: with code INTERRUPTED, after Ctrl-C or SIGTERM ended the
    iteration and it was saved.
    """
    set_threads(cfg.threads)
    rank = join_ranks(cfg.device, cfg.threads)
    run: Run | None = None
    try:
        _check_processes(cfg, rank)
        if checkpoint is None and bool(cfg.start_from) != (start is not None):
            raise InputError("start_from and start, the policy that it names, need each other")
        env = make_env(cfg.num_envs // rank.size, (cfg.seed + 1000 * rank.index) % 2**31, rank.device)
        if cfg.trainer == "rsl-rl":
            return _train_rsl_rl(cfg, env, as_rsl_rl, rank)
        torch.manual_seed(cfg.seed)  # the same weights in all processes
        run = Run(cfg, env, rank, command, start, checkpoint)
        with Stop() as stop:
            result = run.iterate(stop)
        wait_for_ranks()
        if stop.asked:
            raise SystemExit(INTERRUPTED)
        return result
    finally:
        if run is not None:
            run.ppo.close()
        if torch.distributed.is_initialized():
            torch.distributed.destroy_process_group()


def _check_processes(cfg: TrainCfg, rank: Rank) -> None:
    """Raises ValueError: the trainer cannot be had, or worlds or samples do not divide."""
    if cfg.trainer != "ppo" and rank.size > 1:
        raise InputError(f"trainer {cfg.trainer} is offered for one process only")
    if cfg.num_envs % rank.size:
        raise InputError(f"num_envs {cfg.num_envs} is not divisible by {rank.size} processes")
    if cfg.trainer == "ppo":
        cfg.ppo.batch_size(cfg.num_envs // rank.size)


def _check_best_by(name: str, logged: set[str]) -> None:
    """Raises ValueError: no figure of this name is logged."""
    if name not in logged:
        some = ", ".join(sorted(each for each in logged if each.startswith(("Metrics/", "Train/"))))
        raise InputError(f"best_by must name a logged figure, such as {some}, got {name!r:.60}")


def full_config(cfg: TrainCfg, env: VecEnv, rank: Rank) -> dict[str, Any]:
    """Return all settings with versions and commit, ready for JSON."""
    settings = json.loads(json.dumps(dataclasses.asdict(cfg), default=str))
    commit, described = git_commit(), env.config()
    return {
        "train": settings,
        "env": described,
        "processes": rank.size,
        "device": str(rank.device),
        "versions": versions(),
        "commit": commit and commit._asdict(),
        "sources": source_sums(described),
    }


class Run:
    """A training under way in this process."""

    def __init__(
        self, cfg: TrainCfg, env: VecEnv, rank: Rank, command: str | None = None, start: Start | None = None,
        checkpoint: Checkpoint | None = None,
    ) -> None:  # fmt: skip
        """Build the algorithm, and take up a checkpoint if the configuration names one, or else begin with a policy.

        command, start and checkpoint: as in `train`.
        """
        self.cfg, self.env, self.rank = cfg, env, rank
        self._command = command or f"jumper train {cfg.task}"
        by_gradients = cfg.trainer == "shac"
        self.ppo = Shac(cast(DifferentiableVecEnv, env), cfg.ppo, cfg.shac) if by_gradients else Ppo(env, cfg.ppo)
        losses = {f"Loss/{name}" for name in (SHAC_STATISTICS if by_gradients else STATISTICS)}
        _check_best_by(cfg.best_by, {*env.metrics(), *losses, *LEARNING, *PERF})
        self.config = full_config(cfg, env, rank)
        self.iteration, self.seconds = 0, 0.0  # that the run had before this process
        self._begin: float | None = None  # on the clock, as if all seconds that count were of this process
        self.figures: dict[str, float] = {}
        self.notes: list[str] = []
        checkpoint = checkpoint or find_checkpoint(cfg)
        if not all_same(str(checkpoint and (checkpoint.path, checkpoint.state["iteration"]))):
            raise InputError("the processes found different checkpoints: log_root must be a folder that all can read")
        if start is not None and checkpoint is None:
            begin_with(start, self.ppo.model, cfg.num_envs * cfg.ppo.num_steps)
            self.notes.append(", ".join(filter(None, (f"starts from {cfg.start_from}", start.change))))
        torch.manual_seed(cfg.seed + 1 + rank.index)
        self.folder = new_folder(cfg, rank) if checkpoint is None else self._resume(checkpoint)
        if rank.index == 0:
            write_whole(self.folder / CONFIG, json.dumps(self.config, indent=1).encode())

    def _resume(self, checkpoint: Checkpoint) -> Path:
        path, state, refusals = checkpoint
        changed = changes(state, self.config)
        self.notes += [*(f"passed over: {refusal}" for refusal in refusals), f"resumed {path}", *changed]
        self.notes += changed_files(state, self.config)
        try:
            own = own_part(state, self.rank)
            self.ppo.load_state_dict({**state["ppo"], **own["ppo"]})
            self.env.load_state_dict(own["env"])
            self.seconds = spent_seconds(state)
            set_random_state(own["rng"])
        except DAMAGE as error:
            told = f" ({', '.join(changed)})" if changed else ""
            raise CheckpointError(f"{path}: does not fit these settings: {one_line(error)}{told}") from error
        self.iteration = state["iteration"]
        self.config["train"]["start_from"] = started_from(state)
        return path.parent.parent

    def iterate(self, stop: Stop) -> TrainResult:
        """Iterate until the end, the time limit or a wish to stop; log and save on the way."""
        cfg, ppo = self.cfg, self.ppo
        with ThreadPoolExecutor(1) as pool:
            kernels = pool.submit(getattr(self.env, "compile", lambda: None))  # not every `VecEnv` has something to
            one_rank_first(ppo.prepare)
            kernels.result()
        if self.iteration == 0:
            self.env.reset()
        start, first = time.perf_counter(), self.iteration + 1
        watch = Stopwatch(self.rank.device)
        with self._log() as log:
            for note in [f"run {self.folder}", *self.notes]:
                log.say(note)
            ending = is_last_iteration(self.iteration, cfg, 0.0 < cfg.max_seconds <= self.seconds)
            if ending:
                seconds = f"--max-seconds {cfg.max_seconds:g}"
                limit = f"--max-iterations {cfg.max_iterations}" if self.iteration >= cfg.max_iterations else seconds
                log.say(f"nothing is left to train after iteration {self.iteration}: give more than {limit}")
            while not ending:
                watch.start()
                ppo.set_progress(self._progress())
                ppo.iterate(watch.mark)
                self.iteration += 1
                if self.iteration == first:
                    self._begin_counting()
                ending = is_last_iteration(self.iteration, cfg, self.sync_stop_request(stop))
                if ending or self.iteration % cfg.log_interval == 0:
                    times, seconds = watch.read()
                    self.figures = self._read(times, seconds)
                    log.log(self.iteration, self.figures, self._left(seconds))
                elif self.iteration == first:  # it takes longer than the others
                    watch.read()
                if ending or self.iteration % cfg.save_interval == 0:
                    self._save(log, ending, stop)
        return TrainResult(self.folder, self.iteration, time.perf_counter() - start, self.figures)

    def _log(self) -> TrainingLog | _Silent:
        if self.rank.index != 0:
            return _Silent()
        cfg = self.cfg
        return TrainingLog(self.folder, self.config, cfg.max_iterations, cfg.tensorboard, cfg.wandb, self.iteration)

    def _begin_counting(self) -> None:
        """Count the run's time from here on, when the device has done what it was asked to."""
        if self.rank.device.type == "cuda":
            torch.cuda.synchronize()
        self._begin = time.perf_counter() - self.seconds

    def _elapsed(self) -> float:
        """Return the seconds of the run that count, see `TrainCfg.max_seconds`."""
        return self.seconds if self._begin is None else time.perf_counter() - self._begin

    def _progress(self) -> float:
        """Return how much of the training is over, by iterations or by time, whichever is further."""
        timed = self.cfg.max_seconds > 0.0
        return max(self.iteration / self.cfg.max_iterations, self._elapsed() / self.cfg.max_seconds if timed else 0.0)

    def _left(self, seconds: float) -> float:
        """Return how long the rest takes [s] at so many seconds an iteration."""
        left = (self.cfg.max_iterations - self.iteration) * seconds
        if self.cfg.max_seconds > 0.0:
            left = min(left, max(self.cfg.max_seconds - self._elapsed(), 0.0))
        return left

    def sync_stop_request(self, stop: Stop) -> bool:
        """Return whether to end early, because a process was asked to or is at the time limit.

        Several processes exchange this when they log, not otherwise; `stop.asked` becomes the same in all of them.
        """
        late = 0.0 < self.cfg.max_seconds <= self._elapsed()
        if world_size() > 1:
            if self.iteration % self.cfg.log_interval:
                return False
            stop.asked, late = map(bool, largest_over_ranks([int(stop.asked), int(late)]))
        return stop.asked or late

    def _read(self, times: list[float], seconds: float) -> dict[str, float]:
        """Return the figures to log; times: of collect and update [s], seconds: of an iteration."""
        steps = self.cfg.ppo.num_steps * self.cfg.num_envs
        perf = (steps / seconds, *times, self._elapsed())
        return {**self.ppo.statistics(), **self.env.metrics(), **dict(zip(PERF, perf, strict=True))}

    def _save(self, log: TrainingLog | _Silent, ending: bool, stop: Stop) -> None:
        """Save a checkpoint; a failure is only told, and tried again next time, unless this is the last."""
        seconds = self._elapsed()
        own = {"ppo": self.ppo.state_dict(), "env": self.env.state_dict(), "rng": random_state()}
        others = self._others(own)
        if self.rank.index != 0:
            return
        state = {"iteration": self.iteration, "seconds": seconds, **own, "others": others}
        state["config"] = json.dumps(self.config)
        folder = self.folder / CHECKPOINTS
        try:
            path = save_checkpoint(folder, state, self.figures.get(self.cfg.best_by), self.cfg.max_checkpoints)
        except OSError as error:
            if ending:
                raise CheckpointError(f"{folder}: not saved: {error.strerror}") from error
            log.say(f"{folder}: not saved, will try again: {error.strerror}")
            return
        if ending:
            again = f", continue with: {self._command} --resume {shlex.quote(str(self.folder))}"
            log.say(f"saved {path}{again if stop.asked else ''}")

    def _others(self, own: dict[str, Any]) -> list[dict[str, Any]]:
        """Return, in process 0, what only the other processes know: their worlds and random numbers."""
        if world_size() == 1:
            return []
        return gather({**own, "ppo": {"episode": own["ppo"]["episode"].cpu()}}, self.rank)[1:]


def is_last_iteration(iteration: int, cfg: TrainCfg, end_early: bool) -> bool:
    """Return whether a run with so many iterations behind it is at its end."""
    return end_early or iteration >= cfg.max_iterations


class _Silent:
    """Stands for the log in all processes but the first."""

    def __enter__(self) -> _Silent:
        return self

    def __exit__(self, *_: object) -> None:
        pass

    def say(self, line: str) -> None:
        pass

    def log(self, iteration: int, figures: dict[str, float], left: float) -> None:
        pass


def new_folder(cfg: TrainCfg, rank: Rank) -> Path:
    """Make and return the folder of a run that begins now."""
    name = datetime.now().strftime("%Y-%m-%d_%H-%M-%S_%f")
    folder = cfg.log_root / cfg.task / name
    if rank.index == 0:
        folder.mkdir(parents=True)
    return folder


def _train_rsl_rl(cfg: TrainCfg, env: VecEnv, as_rsl_rl: AsRslRl | None, rank: Rank) -> TrainResult:
    if as_rsl_rl is None:
        raise InputError("trainer rsl-rl needs as_rsl_rl, which adapts the environment")
    from jumper_warp.rl.rsl_rl import train_rsl_rl

    folder = new_folder(cfg, rank)
    if rank.index == 0:
        print(f"run {folder}", file=sys.stderr)
        write_whole(folder / CONFIG, json.dumps(full_config(cfg, env, rank), indent=1).encode())
    begin = time.perf_counter()
    torch.manual_seed(cfg.seed + rank.index)
    env.reset()
    adapter = as_rsl_rl(env, cfg.ppo.num_steps)
    train_rsl_rl(adapter, cfg.ppo, cfg.max_iterations, cfg.save_interval, cfg.seed, folder)
    return TrainResult(folder, cfg.max_iterations, time.perf_counter() - begin, {})
