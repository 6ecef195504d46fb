"""Sweep over settings of a training: Optuna chooses, each trial is a training of several seeds side by side.

Any number of workers share one storage. A worker that dies loses nothing: another one, or the next call, continues its
trial from the last checkpoint.
"""

from __future__ import annotations

import json
import os
import re
import shlex
import socket
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np

from jumper_warp.compare.statistics import interquartile_mean
from jumper_warp.compare.training import train_arm
from jumper_warp.recipe import Recipe
from jumper_warp.rl.metrics_file import last_metrics
from jumper_warp.rl.run_folder import INTERRUPTED
from jumper_warp.rl.run_names import seed_folders
from jumper_warp.rl.runner import Observer
from jumper_warp.rl.training_run import TrainingRun
from jumper_warp.utils.checks import NAME, check_count, check_finite, check_not_negative, check_types
from jumper_warp.utils.errors import InputError
from jumper_warp.utils.files import Json, directory_lock

POLL = 2.0  # [s] Time between two looks at the trials of other workers
FIXED = ("task", "flags", "seeds", "metric", "direction", "parameters", "modules")
"""Settings that all trials of a sweep share."""
RUN, ALIVE, WORKER = "run", "alive", "worker"  # Attributes of a trial: name of its run, time of the last sign, process


@dataclass(frozen=True)
class Sweep:
    """Settings of a sweep, as in its file."""

    name: str
    task: str
    parameters: Json
    """By flag of `jumper train` without dashes: low and high, perhaps log or step; or choices."""
    seeds: tuple[int, ...] = (1, 2, 3, 4)  # Seeds of each trial, trained side by side
    trials: int = 20  # Number of trials that finish or are pruned
    flags: str = ""  # Flags of `jumper train` for all trials
    metric: str = "Metrics/success"  # Logged metric to optimise, interquartile mean over seeds
    direction: Literal["maximize", "minimize"] = "maximize"
    pruning: bool = True  # Whether trials below the median of the finished ones at the same iteration end early
    startup_trials: int = 5  # Number of random trials before Optuna chooses, and before trials are pruned
    seed: int = 0  # Seed of Optuna's choices
    log_root: Path = Path("logs")  # Folder of the sweep's folder, `log_root/name`
    storage: str = "sqlite"  # sqlite, journal (for folders on a network), or an URL of a database
    grace: float = 300.0  # [s] Time without a sign of life after which another host's trial is continued
    modules: tuple[str, ...] = field(default=())  # Files of tasks, relative to the sweep's file

    def __post_init__(self) -> None:
        """Raise InputError: a field is of another type or out of range, or a flag is one that the sweep sets."""
        if self.log_root == "":
            raise InputError("sweep: log_root is empty")
        object.__setattr__(self, "log_root", Path(self.log_root))
        check_types("sweep:", self)
        check_count("sweep: number of seeds", len(self.seeds))
        check_count("sweep: trials", self.trials)
        check_not_negative("sweep: grace", self.grace)
        if not NAME.fullmatch(self.name):
            raise InputError(f"sweep: name may contain letters, digits, _ . - and spaces, got {self.name!r:.60}")
        flags = [*shlex.split(self.flags), *(f"--{name}" for name in self.parameters)]
        for flag in ("--seeds", "--run-name", "--log-root"):
            if any(word.partition("=")[0].replace("_", "-") == flag for word in flags):
                raise InputError(f"the sweep sets {flag}: remove it from flags and parameters")
        if not self.parameters:
            raise InputError("a sweep needs parameters, such as parameters.'ppo.lr' = {low = 1e-4, high = 1e-2}")

    @property
    def folder(self) -> Path:
        """Folder of the sweep, with storage, runs and report."""
        return self.log_root / self.name

    def distributions(self) -> Json:
        """Return Optuna's distribution of each parameter. Raises InputError: one is malformed."""
        from optuna.distributions import CategoricalDistribution, FloatDistribution, IntDistribution

        kinds = {}
        for name, spec in self.parameters.items():
            try:
                whole = all(type(spec.get(end)) is int for end in ("low", "high"))
                number = IntDistribution if whole else FloatDistribution
                kind: Any = CategoricalDistribution if "choices" in spec else number
                kinds[name] = kind(**spec)
                for choice in spec.get("choices", ()):
                    shlex.split(str(choice))  # as in `arguments`
            except (TypeError, ValueError, AttributeError) as error:
                raise InputError(f"parameter {name}: {error}") from error
            check_finite(f"parameter {name}", *(value for value in spec.values() if isinstance(value, float)))
        return kinds

    def arguments(self, params: Json, run: str) -> list[str]:
        """Return the arguments of `jumper train` for a trial. run: its name."""
        seeds = ["--seeds", *map(str, self.seeds), "--run-name", run, "--log-root", str(self.folder)]
        return [self.task, *shlex.split(self.flags), *shlex.split(flags_of(params)), *seeds, "--no-tensorboard"]


def flags_of(params: Json) -> str:
    """Return the flags of a trial's parameters; true becomes the flag alone, false its opposite, `--ppo.no-fused`."""
    text = " ".join(f"--{name} {value}" for name, value in params.items()) + " "
    return re.sub(r"(--|\.)([^.\s]+) False ", r"\1no-\2 ", text.replace(" True ", " ")).strip()


def open_study(sweep: Sweep, worker: int = 0) -> Any:
    """Return the Optuna study of a sweep, which is created if it does not exist; worker: index of this process.

    Raises InputError: the storage cannot be opened, a setting is out of Optuna's range, or the study has another one of
    the settings FIXED.
    """
    import optuna
    from optuna.storages.journal import JournalFileBackend, JournalStorage

    optuna.logging.set_verbosity(optuna.logging.WARNING)
    sweep.folder.mkdir(parents=True, exist_ok=True)
    storage: Any = sweep.storage
    try:
        with directory_lock(sweep.folder):  # workers that start together would create the tables twice
            if storage == "sqlite":
                storage = optuna.storages.RDBStorage(
                    f"sqlite:///{sweep.folder.resolve()}/study.db", engine_kwargs={"connect_args": {"timeout": 60}}
                )
            elif storage == "journal":
                storage = JournalStorage(JournalFileBackend(str(sweep.folder / "journal.log")))
            pruner = optuna.pruners.MedianPruner(sweep.startup_trials) if sweep.pruning else optuna.pruners.NopPruner()
            sampler = optuna.samplers.TPESampler(n_startup_trials=sweep.startup_trials, seed=sweep.seed + worker)
            study = optuna.create_study(
                study_name=sweep.name, storage=storage, load_if_exists=True, direction=sweep.direction, pruner=pruner,
                sampler=sampler,
            )  # fmt: skip
            for name in FIXED:
                value = json.loads(json.dumps(getattr(sweep, name)))
                if (saved := study.user_attrs.get(name, value)) != value:
                    raise InputError(f"sweep {sweep.name}: {name} was {saved!r:.60}, got {value!r:.60}: rename it")
                study.set_user_attr(name, value)
            return study
    except Exception as error:  # of Optuna, of the storage, or of a damaged journal
        raise InputError(f"sweep {sweep.name}: {error!s:.200}") from error


def work(sweep: Sweep, recipe_of: Callable[[Sequence[str]], Recipe], worker: int = 0) -> None:
    """Run trials until the sweep has `trials` finished or pruned ones, also those of workers that died.

    recipe_of: function of arguments of `jumper train`. worker: index of this process. Raises InputError: the storage
    fails.
    """
    from optuna.exceptions import StorageInternalError
    from optuna.trial import TrialState
    from sqlalchemy.exc import SQLAlchemyError

    study = open_study(sweep, worker)
    try:
        while True:
            requeue_abandoned(study, sweep.grace)
            states = [trial.state for trial in study.get_trials(deepcopy=False)]
            done = states.count(TrialState.COMPLETE) + states.count(TrialState.PRUNED)
            if done >= sweep.trials:
                return
            if done + states.count(TrialState.RUNNING) >= sweep.trials and TrialState.WAITING not in states:
                time.sleep(POLL)  # the last trials run elsewhere, and may yet be abandoned
            else:
                run_trial(study, study.ask(sweep.distributions()), sweep, recipe_of)
    except (StorageInternalError, SQLAlchemyError) as error:
        raise InputError(f"storage of sweep {sweep.name}: {error!s:.200}") from error


def requeue_abandoned(study: Any, grace: float) -> None:
    """Queue the trials of workers that died once more, with the same parameters and run."""
    from optuna.exceptions import UpdateFinishedTrialError
    from optuna.trial import TrialState

    for trial in study.get_trials(deepcopy=False, states=(TrialState.RUNNING,)):
        attributes = trial.user_attrs
        if RUN in attributes and not _is_alive(attributes, grace):
            try:
                study.tell(trial.number, state=TrialState.FAIL)
            except (UpdateFinishedTrialError, ValueError):
                continue  # another worker was first
            study.enqueue_trial(trial.params, user_attrs={RUN: attributes[RUN]})


def _is_alive(attributes: Json, grace: float) -> bool:
    """Return whether the worker of a trial runs: its process on this host, else a sign within `grace` [s]."""
    host, _, process = attributes[WORKER].partition(":")
    if host == socket.gethostname():
        with suppress(OSError):  # no such process
            state = Path(f"/proc/{process}/stat").read_text().rpartition(") ")[2][0]
            return state != "Z"  # a killed process whose parent has not asked for its end still has an entry
        return False
    return time.time() - attributes[ALIVE] < grace


class TrialReport(Observer):
    """Observer that reports the metric of a trial's seeds to the study, and ends a trial below the median.

    begun: whether the training has begun, so that its settings are valid.
    """

    def __init__(self, trial: Any, sweep: Sweep) -> None:
        """Report to a trial of Optuna."""
        self._trial = trial
        self._sweep = sweep
        self.begun = False

    def begin(self, runs: Sequence[TrainingRun]) -> None:
        """Raise InputError: the trainings do not log the metric."""
        self.begun = True
        runs[0].check_logged("metric", self._sweep.metric)

    def after_iteration(self, runs: Sequence[TrainingRun]) -> None:
        """Report the mean of the finite metrics of a logged iteration. Raises TrialPruned: it is below the median."""
        from optuna.exceptions import TrialPruned

        iteration = max(run.iteration for run in runs)  # that of a frozen seed does not grow
        if iteration % runs[0].cfg.log_interval == 0:
            self._trial.set_user_attr(ALIVE, time.time())
            logged = np.array([run.metrics.get(self._sweep.metric, np.nan) for run in runs])
            if np.isfinite(logged).any():
                self._trial.report(float(interquartile_mean(logged[np.isfinite(logged)])), iteration)
            if self._trial.should_prune():
                raise TrialPruned(f"pruned at iteration {iteration}")


def run_trial(study: Any, trial: Any, sweep: Sweep, recipe_of: Callable[[Sequence[str]], Recipe]) -> None:
    """Train the seeds of a trial, or continue its run, and save the result in the study.

    A trial whose settings are invalid, or whose training fails, is pruned.
    """
    from optuna.exceptions import TrialPruned
    from optuna.trial import TrialState

    run = trial.user_attrs.get(RUN, f"trial_{trial.number:03d}")
    trial.set_user_attr(WORKER, f"{socket.gethostname()}:{os.getpid()}")
    trial.set_user_attr(ALIVE, time.time())
    trial.set_user_attr(RUN, run)
    report = TrialReport(trial, sweep)
    try:
        folder = train_arm(recipe_of(sweep.arguments(trial.params, run)), [report])
        logged = [last_metrics(each) for each in seed_folders(folder).values()]
        values = [metrics[sweep.metric] for metrics in logged if metrics.get(sweep.metric) is not None]
        if not values:
            raise TrialPruned(f"has not logged {sweep.metric} at its end; it logged {', '.join(logged[0])}")
    except (TrialPruned, InputError, SystemExit) as error:
        if error.args == (INTERRUPTED,) or (report.begun and isinstance(error, InputError)):
            raise
        print(f"{run}: {'invalid flags' if error.args == (2,) else error}")  # tyro has printed which
        study.tell(trial, state=TrialState.PRUNED)
        return
    study.tell(trial, float(interquartile_mean(np.array(values))))
