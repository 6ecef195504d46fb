"""`jumper sweep FILE`: optimise settings of a training; `--workers` shares the trials among processes or Slurm jobs."""

from __future__ import annotations

import ast
import os
import signal
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Any, Literal

import tyro

from jumper_warp.cli.compare import read_settings
from jumper_warp.cli.flags import parse
from jumper_warp.cli.main import FAULT, print_error
from jumper_warp.registry import load_task_module
from jumper_warp.utils.checks import check_count
from jumper_warp.utils.errors import InputError

if TYPE_CHECKING:
    from jumper_warp.compare.sweep import Sweep
    from jumper_warp.recipe import Recipe

GPUS = "CUDA_VISIBLE_DEVICES"


@dataclass(frozen=True)
class SweepCfg:
    """Optimise settings of a training with Optuna, each trial several seeds; write a report.

    The file (TOML) names task, flags, seeds, metric and parameters. A sweep that was stopped continues. A training on
    several machines is not a sweep: use torchrun.
    """

    file: tyro.conf.Positional[Path]  # Settings of the sweep
    workers: int = 1  # Number of processes that share the trials; 1: this process
    cluster: Literal["local", "slurm"] = "local"  # Where more than one worker runs: this machine, or a Slurm job array
    slurm: tuple[str, ...] = ()  # Settings of submitit for each job, such as slurm_partition=gpu timeout_min=240
    report: bool = False  # Write the report of the trials so far, and train nothing


def run(args: Sequence[str], modules: Sequence[ModuleType] = ()) -> None:
    """Run `jumper sweep` with the given arguments; modules: loaded by --task-module.

    Raises InputError or OSError: the file is invalid.
    """
    cfg: SweepCfg = parse(SweepCfg, "sweep", args)
    sweep = read_sweep(cfg.file)
    try:
        import optuna  # noqa: F401
    except ImportError as error:
        raise InputError('jumper sweep needs Optuna: pip install "jumper-warp[sweep]"') from error
    sweep.distributions()
    recipe_of(sweep.arguments({}, "checked"))
    if not cfg.report:
        if check_count("workers", cfg.workers) == 1 and cfg.cluster == "local":
            work_on(cfg.file)
        else:
            wait_for(submit(cfg, sweep.folder), cancel=cfg.cluster == "local")
    from jumper_warp.compare.sweep_report import write_sweep_report

    print(write_sweep_report(sweep))


def submit(cfg: SweepCfg, folder: Path) -> list:
    """Start the workers as jobs of submitit, and return them; their logs are in the sweep's folder.

    Raises InputError: a setting of submitit is invalid, or there is no such cluster.
    """
    import submitit

    pairs = (setting.partition("=")[::2] for setting in cfg.slurm)
    try:
        executor = submitit.AutoExecutor(folder / "workers", cluster=cfg.cluster)
        executor.update_parameters(**{"timeout_min": 24 * 60, **{name: number(value) for name, value in pairs}})
    except (AssertionError, NameError, RuntimeError, ValueError) as error:
        raise InputError(f"{cfg.cluster}: {error}") from error
    stderr = os.dup(2)
    interrupt = signal.signal(signal.SIGINT, signal.default_int_handler)  # else a worker of `sweep ... &` ignores it
    with (folder / "workers" / "controllers.log").open("ab") as log:
        os.dup2(log.fileno(), 2)  # of submitit's controllers, which print a traceback when they are interrupted
    try:
        gpus = [os.environ.get(GPUS)] * cfg.workers
        return executor.map_array(work_on, [cfg.file] * cfg.workers, range(cfg.workers), gpus)
    finally:
        signal.signal(signal.SIGINT, interrupt)
        os.dup2(stderr, 2)
        os.close(stderr)


def wait_for(jobs: Sequence[Any], *, cancel: bool) -> None:
    """Wait for jobs of submitit; if cancel, Ctrl-C, SIGTERM or SIGHUP ends them, and then this process.

    Other workers continue the trials of one that fails. Exits with FAULT if all fail.
    """
    for each in (signal.SIGTERM, signal.SIGHUP):
        if signal.getsignal(each) is signal.SIG_DFL:  # not with nohup
            signal.signal(each, lambda number, _: sys.exit(128 + number))
    failures = 0
    try:
        for job in jobs:
            try:
                job.result()
            except RuntimeError:  # submitit's, with the worker's traceback, or without a result of a killed worker
                failures += 1
                print_error(f"a worker failed, see {job.paths.stderr}")
    except (KeyboardInterrupt, SystemExit):
        for job in jobs if cancel else ():
            job.cancel()
        raise
    if failures == len(jobs):
        raise SystemExit(FAULT)


def number(text: str) -> object:
    """Return the number that a text denotes, else the text."""
    try:
        return ast.literal_eval(text)
    except (ValueError, SyntaxError):
        return text


def work_on(file: Path, worker: int = 0, gpus: str | None = "") -> None:
    """Run trials of a sweep in this process until all are done.

    worker: index of the process. gpus: value of GPUS in place of "", which submitit's local executor sets to hide all.
    """
    if os.environ.get(GPUS) == "":
        del os.environ[GPUS]
        os.environ |= {} if gpus is None else {GPUS: gpus}
    from jumper_warp.compare.sweep import work

    work(read_sweep(file), recipe_of, worker)


def read_sweep(file: Path) -> Sweep:
    """Return the settings of a sweep, and load its files of tasks. Raises InputError: they are invalid."""
    from jumper_warp.compare.sweep import Sweep

    sweep = read_settings(Sweep, file, name=file.stem)
    for module in sweep.modules:
        load_task_module(str(file.parent / module))
    return sweep


def recipe_of(arguments: Sequence[str]) -> Recipe:
    """Return the recipe of arguments of `jumper train`."""
    from jumper_warp.cli.train import parse_train

    return parse_train(arguments)[0]
