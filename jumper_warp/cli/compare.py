"""`jumper compare A B ...`: compare runs, groups of seeds or policies; `--file` also trains the arms."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from types import ModuleType
from typing import Annotated

import tyro

from jumper_warp.cli.main import UsageError, parse
from jumper_warp.evaluation.conditions import Conditions


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
    cfg: CompareCfg = parse(CompareCfg, "compare", args)
    if cfg.file is None and len(cfg.sources) == 0:
        raise UsageError("name what to compare: jumper compare A B, or jumper compare --file FILE.toml")
    from jumper_warp.compare.comparison import compare
    from jumper_warp.compare.report import lines, write_report
    from jumper_warp.utils.output import output_dir

    comparison = compare(
        *cfg.sources, metric=cfg.metric, primary=cfg.primary, evaluate=cfg.evaluate, conditions=cfg.conditions,
        modules=modules,
    )  # fmt: skip
    print("\n".join(lines(comparison)))
    print(write_report(comparison, output_dir("compare", cfg.out), html=cfg.html))
