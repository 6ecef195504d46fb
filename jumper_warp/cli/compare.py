"""`jumper compare A B ...`: compare runs, groups of seeds or policies; `--file` also trains the arms."""

from __future__ import annotations

import shlex
import tomllib
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from types import ModuleType
from typing import Annotated, Any

import tyro

from jumper_warp.cli.flags import parse, values_of
from jumper_warp.cli.main import UsageError
from jumper_warp.evaluation.conditions import Conditions
from jumper_warp.registry import load_task_module
from jumper_warp.utils.checks import check_count, check_types
from jumper_warp.utils.errors import InputError
from jumper_warp.utils.files import Json, read_file


@dataclass(frozen=True)
class CompareCfg:
    """Compare runs, groups of seeds or policies: learning curves, evaluation, rewards, settings.

    The first one is the base. A source is a run's folder, a folder of runs, a pattern such as logs/vertical-jump/base*
    of folders' or runs' names, or a policy. Runs of one name are an arm; NAME=SOURCE names one.
    """

    sources: tyro.conf.Positional[tuple[str, ...]] = ()  # Runs, patterns or policies, the base first
    file: Path | None = None  # Settings file (TOML) of arms to train and compare; finished trainings are kept
    metric: str = ""  # Logged metric of the learning curves (default: the one that selects checkpoints)
    primary: str = ""
    """Metric to test, of the evaluation or the log; a minus sign before it if smaller is better (default: success rate
    or error of the evaluation)."""
    evaluate: bool = True  # Evaluate the best checkpoint of every seed, as jumper evaluate
    html: bool = False  # Also write the page as one HTML file
    out: Path | None = None  # Folder for picture, page and data (default: outputs/compare/<time>)
    conditions: Annotated[Conditions, tyro.conf.arg(name="")] = field(default_factory=Conditions)
    """Conditions of the evaluation."""


@dataclass(frozen=True)
class ArmsFile:
    """Settings file of arms to train and compare."""

    arms: Json  # By name: flags of `jumper train`, or a table of task and flags
    seeds: tuple[int, ...]  # Seeds of each arm
    task: str = ""  # Task of the arms that are no table
    flags: str = ""  # Flags of `jumper train` for all arms
    log_root: str = "logs"  # Folder of the runs
    modules: tuple[str, ...] = ()  # Files of tasks, relative to this file
    title: str = "Comparison"
    primary: str = ""  # Metric to test
    evaluation: Json = field(default_factory=dict)  # Flags of `jumper evaluate` by name
    conditions: Any = field(default_factory=dict)  # Conditions of the evaluation by name

    def __post_init__(self) -> None:
        """Raise InputError: a field is invalid, or there are no seeds. TypeError: there is no such condition."""
        check_types("arms:", self)
        check_count("arms: number of seeds", len(self.seeds))
        object.__setattr__(self, "conditions", Conditions(**with_tuples(self.conditions)))


def run(args: Sequence[str], modules: Sequence[ModuleType] = ()) -> None:
    """Run `jumper compare` with the given arguments; modules: loaded by --task-module.

    Raises InputError or OSError: a source, setting or file is invalid.
    """
    path = values_of("--file", args)
    settings = read_settings(ArmsFile, Path(path[0])) if path else ArmsFile({}, (1,))
    default = CompareCfg(primary=settings.primary, conditions=settings.conditions)
    cfg: CompareCfg = parse(CompareCfg, "compare", args, default=default)
    if (cfg.file is None) == (len(cfg.sources) == 0):
        raise UsageError("name what to compare: jumper compare A B, or jumper compare --file FILE.toml")
    sources = cfg.sources
    if cfg.file is not None:
        modules = [*modules, *(load_task_module(str(cfg.file.parent / name)) for name in settings.modules)]
        sources = train_file(settings)
    from jumper_warp.compare.comparison import compare
    from jumper_warp.compare.report import lines, write_report

    comparison = compare(
        *sources, metric=cfg.metric, primary=cfg.primary, evaluate=cfg.evaluate, conditions=cfg.conditions,
        modules=modules, evaluation=with_tuples(settings.evaluation), title=settings.title,
    )  # fmt: skip
    page = write_report(comparison, cfg.out, html=cfg.html)  # first, since a reader such as head may close the pipe
    print(*lines(comparison), page, sep="\n")


def train_file(settings: ArmsFile) -> list[str]:
    """Train the arms of a settings file that are not finished, and return them as sources NAME=RUN.

    Raises InputError: an arm is invalid.
    """
    from jumper_warp.cli.train import parse_train
    from jumper_warp.compare.training import train_arm

    def arguments(name: str, task: str, flags: str = "") -> list[str]:
        seeds = ["--seeds", *map(str, settings.seeds), "--log-root", settings.log_root, "--no-tensorboard"]
        return [task, *shlex.split(settings.flags), *seeds, *shlex.split(flags), "--run-name", name]

    recipes = {}
    for name, arm in settings.arms.items():
        table = {"task": settings.task, "flags": arm} if isinstance(arm, str) else arm
        try:
            args = arguments(name, **table)
        except (TypeError, ValueError, AttributeError) as error:
            raise InputError(f"arm {name}: {error}") from error
        recipes[name] = parse_train(args)[0]
    return [f"{name}={train_arm(recipe)}" for name, recipe in recipes.items()]


def read_settings(kind: Any, path: Path, **defaults: Any) -> Any:
    """Return a dataclass with the settings of a TOML file. Raises InputError: they are missing or malformed."""
    content = read_file(path, "settings")
    try:
        return kind(**defaults | with_tuples(tomllib.loads(content.decode())))
    except (TypeError, ValueError, AttributeError) as error:
        raise InputError(f"{path}: {error}") from error


def with_tuples(values: Json) -> Json:
    """Return values with tuples in place of lists, as dataclasses have them."""
    return {name: tuple(value) if isinstance(value, list) else value for name, value in values.items()}
