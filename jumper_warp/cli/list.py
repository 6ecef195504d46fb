"""`jumper list`: list all tasks and the project's policies, one a line; `jumper list runs`: list trainings."""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING

from jumper_warp.cli.flags import parse
from jumper_warp.utils.files import Json

if TYPE_CHECKING:
    from jumper_warp.policies.catalog import PolicySummary

LEGEND = """\
success, error: nominal robot, commands in range. A jump succeeds within 0.1 m
of its goal, landed and at rest; a walk without a fall; a turn if it settles.
error: mean of jumps and turns, RMSE of the velocity ahead of walks.
size: of the network's file.

jumper info NAME shows a task or a policy."""


@dataclass(frozen=True)
class ListCfg:
    """List all tasks and the project's policies."""

    json: bool = False  # Print JSON


@dataclass(frozen=True)
class RunsCfg:
    """List the trainings in a log folder, the newest first."""

    log_root: Path = Path("logs")  # Folder of all runs
    json: bool = False  # Print JSON


def run(args: Sequence[str], modules: Sequence[ModuleType] = ()) -> None:
    """Print tasks and policies, or with `runs` the trainings, one a line; modules: loaded by --task-module."""
    if args[:1] == ["runs"]:
        print_runs(parse(RunsCfg, "list runs", args[1:]))
        return
    cfg = parse(ListCfg, "list", args)
    from jumper_warp.policies.catalog import summarise
    from jumper_warp.utils.assets import POLICIES, policy_tasks

    policies = [summarise(POLICIES / name) for name in policy_tasks()]
    tasks, failures = describe_tasks(policies)
    if cfg.json:
        print(json.dumps({"tasks": tasks, "policies": [describe(policy) for policy in policies]}, indent=2))
    else:
        print_tables(tasks, policies)
    for line in failures:
        print(line, file=sys.stderr)


def describe_tasks(policies: Sequence[PolicySummary]) -> tuple[list[Json], list[str]]:
    """Return the description of every task as JSON data, and a line for each package whose task cannot be loaded."""
    from jumper_warp.registry import TASKS, installed_tasks, load_installed, package_of

    packages = {}
    failures = []
    for entry_point in installed_tasks():
        name = entry_point.name
        package = package_of(entry_point)
        try:
            load_installed(entry_point)
            packages[name] = package
        except Exception as error:  # an error in one package must not hide the tasks of others
            reason = " ".join(f"{type(error).__name__}: {error}".split())
            failures.append(f"task {name} of package {package} is left out: {reason:.300}")
    tasks = [
        {
            "name": name,
            "about": entry.description,
            "aliases": list(entry.aliases),
            "module": entry.origin,
            "package": packages.get(name),
            "policies": [policy.name for policy in policies if policy.task == name],
        }
        for name, entry in TASKS.items()
    ]
    return tasks, failures


def describe(policy: PolicySummary) -> Json:
    """Return a policy's name, task, success rate, error, size and folder as JSON data; None: not evaluated."""
    return {"name": policy.name, "task": policy.task, "success_rate": policy.success, "error": policy.error,
            "size_bytes": policy.size_bytes, "folder": str(policy.folder)}  # fmt: skip


def print_tables(tasks: Sequence[Json], policies: Sequence[PolicySummary]) -> None:
    """Print one table of the tasks and one of the policies, each under a heading."""
    from rich.table import Column, Table

    from jumper_warp.utils.tables import print_table

    style: Json = {"box": None, "pad_edge": False, "padding": (0, 2, 0, 0)}
    table = Table(Column("TASK", no_wrap=True), "what the robot does", Column("its policies", no_wrap=True), **style)
    for task in tasks:
        table.add_row(task["name"], task["about"], ",\n".join(task["policies"]))
    print_table(table)
    print()
    table = Table(
        "POLICY", "its task", *(Column(name, justify="right") for name in ("success", "error", "size")), **style
    )
    for policy in policies:
        success = "" if policy.success is None else f"{100.0 * policy.success:.1f} %"
        table.add_row(policy.name, policy.task, success, quantity(policy.error), size_text(policy.size_bytes))
    print_table(table)
    print("", LEGEND, sep="\n")


def describe_run(folder: Path) -> Json:
    """Return a training's name, task, start, seeds, success, iteration, commit, tags and folder as JSON data.

    success: last logged one, mean over seeds; None: not logged. Raises InputError: its configuration is unreadable.
    """
    from jumper_warp.rl.metrics_file import last_metrics
    from jumper_warp.rl.run_names import seed_folders, start_time, title
    from jumper_warp.utils.files import read_json

    folders = list(seed_folders(folder).values()) or [folder]
    configs = [read_json(each / "config.json", "settings of a run") for each in folders]
    lines = [last_metrics(each) for each in folders]
    known = [value for line in lines if (value := line.get("Metrics/success")) is not None]
    train = configs[0]["train"]
    return {
        "name": title(folder),
        "task": str(train["task"]),
        "started": start_time(folder),
        "seeds": [config["train"]["seed"] for config in configs],
        "success": sum(map(float, known)) / len(known) if known else None,
        "iteration": max(int(line.get("iteration") or 0) for line in lines),
        "commit": str((configs[0].get("commit") or {}).get("hash") or ""),
        "tags": [str(tag) for tag in train.get("tags", ())],
        "folder": str(folder),
    }


def print_runs(cfg: RunsCfg) -> None:
    """Print a table, or JSON data, of the trainings in a log folder; folders without readable settings are left out."""
    from rich.table import Column, Table

    from jumper_warp.utils.progress import format_duration
    from jumper_warp.utils.tables import print_table

    runs = []
    for folder in cfg.log_root.glob("*/*/"):
        with suppress(ValueError, LookupError, TypeError, AttributeError, OSError):
            runs.append(describe_run(folder))
    runs.sort(key=lambda run: run["started"], reverse=True)
    if cfg.json:
        print(json.dumps(runs, indent=2))
        return
    right = {"justify": "right", "no_wrap": True}
    names = [Column("RUN", overflow="fold"), "task", *(Column(name, **right) for name in ("age", "seeds", "success"))]
    table = Table(*names, "commit", "tags", box=None, pad_edge=False, padding=(0, 2, 0, 0))
    for run in runs:
        success = "" if run["success"] is None else f"{100.0 * run['success']:.1f} %"
        seeds = ", ".join(map(str, run["seeds"]))
        age = format_duration(time.time() - run["started"])
        table.add_row(run["name"], run["task"], age, seeds, success, run["commit"][:8], ", ".join(run["tags"]))
    if runs:
        print_table(table)
    else:
        print(f"jumper: {cfg.log_root}: no trainings", file=sys.stderr)


def quantity(metric: Json | None) -> str:
    """Return value and unit of a metric, as in metrics.json, with two significant digits; empty for None."""
    if metric is None or metric["value"] is None:
        return ""
    return f"{metric['value']:.2g} {metric['unit'] or ''}".strip()


def size_text(size_bytes: int) -> str:
    """Return a file's size in kB or MB."""
    return f"{size_bytes / 1e6:.1f} MB" if size_bytes >= 1e6 else f"{size_bytes / 1e3:.0f} kB"
