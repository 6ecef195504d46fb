"""`jumper compare A B ...`: compare runs, groups of seeds or policies; `--file` also trains the arms."""

from __future__ import annotations

import shlex
import tomllib
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from types import ModuleType
from typing import Annotated

import tyro

from jumper_warp.cli.flags import values_of
from jumper_warp.cli.main import UsageError, parse
from jumper_warp.evaluation.conditions import Conditions
from jumper_warp.registry import load_task_module
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


def run(args: Sequence[str], modules: Sequence[ModuleType] = ()) -> None:
    """Run `jumper compare` with the given arguments; modules: loaded by --task-module.

    Raises InputError or OSError: a source, setting or file is invalid.
    """
    path = values_of("--file", args)
    settings = read_toml(Path(path[0])) if path else {}
    conditions = Conditions(**settings.get("conditions", {}))
    cfg: CompareCfg = parse(
        CompareCfg, "compare", args, default=CompareCfg(primary=settings.get("primary", ""), conditions=conditions)
    )
    if (cfg.file is None) == (len(cfg.sources) == 0):
        raise UsageError("name what to compare: jumper compare A B, or jumper compare --file FILE.toml")
    sources = cfg.sources
    if cfg.file is not None:
        modules = [*modules, *(load_task_module(str(cfg.file.parent / name)) for name in settings.get("modules", ()))]
        sources = train_file(settings)
    from jumper_warp.compare.comparison import compare
    from jumper_warp.compare.report import lines, write_report

    comparison = compare(
        *sources, metric=cfg.metric, primary=cfg.primary, evaluate=cfg.evaluate, conditions=cfg.conditions,
        modules=modules, evaluation=with_tuples(settings.get("evaluation", {})),
        title=settings.get("title", "Comparison"),
    )  # fmt: skip
    print("\n".join(lines(comparison)))
    print(write_report(comparison, cfg.out, html=cfg.html))


def train_file(settings: Json) -> list[str]:
    """Train the arms of a settings file that are not finished, and return them as sources NAME=RUN."""
    from jumper_warp.cli.train import parse_train
    from jumper_warp.compare.training import train_arm

    common = [*shlex.split(settings.get("flags", "")), "--seeds", *map(str, settings["seeds"])]
    common += ["--log-root", settings.get("log_root", "logs"), "--no-tensorboard"]
    recipes = {}
    for name, arm in settings["arms"].items():
        task, flags = (settings["task"], arm) if isinstance(arm, str) else (arm["task"], arm.get("flags", ""))
        recipes[name] = parse_train([task, *common, *shlex.split(flags), "--run-name", name])[0]
    return [f"{name}={train_arm(recipe)}" for name, recipe in recipes.items()]


def read_toml(path: Path) -> Json:
    """Return the content of a TOML file. Raises InputError: it is missing or malformed."""
    try:
        return tomllib.loads(read_file(path, "settings").decode())
    except ValueError as error:
        raise InputError(f"{path}: {error}") from error


def with_tuples(values: Json) -> Json:
    """Return values with tuples in place of lists, as dataclasses have them."""
    return {name: tuple(value) if isinstance(value, list) else value for name, value in values.items()}
