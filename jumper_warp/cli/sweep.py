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
from jumper_warp.cli.main import parse
from jumper_warp.registry import load_task_module
from jumper_warp.utils.errors import InputError

if TYPE_CHECKING:
    from jumper_warp.compare.sweep import Sweep
    from jumper_warp.recipe import Recipe


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
        if cfg.workers == 1:
            work_on(cfg.file)
        else:
            wait_for(submit(cfg, sweep.folder), cancel=cfg.cluster == "local")
    from jumper_warp.compare.sweep_report import write_sweep_report

    print(write_sweep_report(sweep))


def submit(cfg: SweepCfg, folder: Path) -> list:
    """Start the workers as jobs of submitit, and return them; their logs are in the sweep's folder."""
    import submitit

    executor = submitit.AutoExecutor(folder / "workers", cluster=cfg.cluster)
    pairs = (setting.partition("=")[::2] for setting in cfg.slurm)
    executor.update_parameters(**{"timeout_min": 24 * 60, **{name: number(value) for name, value in pairs}})
    stderr = os.dup(2)
    with (folder / "workers" / "controllers.log").open("ab") as log:
        os.dup2(log.fileno(), 2)  # of submitit's controllers, which print a traceback when they are interrupted
    try:
        return executor.map_array(work_on, [cfg.file] * cfg.workers, range(cfg.workers))
    finally:
        os.dup2(stderr, 2)
        os.close(stderr)


def wait_for(jobs: Sequence[Any], *, cancel: bool) -> None:
    """Wait for jobs of submitit; if cancel, Ctrl-C, SIGTERM or SIGHUP ends them, and then this process."""
    for each in (signal.SIGTERM, signal.SIGHUP):
        if signal.getsignal(each) is signal.SIG_DFL:  # not with nohup
            signal.signal(each, lambda number, _: sys.exit(128 + number))
    try:
        for job in jobs:
            job.result()
    except (KeyboardInterrupt, SystemExit):
        for job in jobs if cancel else ():
            job.cancel()
        raise


def number(text: str) -> object:
    """Return the number that a text denotes, else the text."""
    try:
        return ast.literal_eval(text)
    except (ValueError, SyntaxError):
        return text


def work_on(file: Path, worker: int = 0) -> None:
    """Run trials of a sweep in this process until all are done; worker: its index."""
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
