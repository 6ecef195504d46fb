"""`jumper info NAME`: describe a task or a policy."""

from __future__ import annotations

import json
import os
import textwrap
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Any

import tyro

from jumper_warp.cli.flags import parse
from jumper_warp.cli.list import describe, size_text
from jumper_warp.utils.files import Json
from jumper_warp.utils.tables import WIDTH, table_lines

if TYPE_CHECKING:
    from jumper_warp.policies.catalog import PolicySummary
    from jumper_warp.tasks.cfg import TaskCfg

INDENT = 14  # Characters before the values of a list of properties
UNBROKEN = "\N{NO-BREAK SPACE}"  # Printed as a space


COLUMNS = {
    "success": "success_rate", "settled": "settled_without_collision_rate", "landed": "landed_rate",
    "apex error": "apex_error_abs_mean_m", "error at rest": "goal_distance_at_rest_mean_m",
    "RMSE ahead": "settled_rmse_vx_m_s", "to the side": "settled_rmse_vy_m_s",
    "turning": "settled_rmse_yaw_rate_rad_s", "settling time": "settling_time_mean_s",
    "error at end": "error_at_end_mean_deg", "falls": "fall_rate",
}  # fmt: skip
"""Columns of a policy's table: metric by title; those whose metrics it lacks are left out."""


@dataclass(frozen=True)
class InfoCfg:
    """Describe a task or a policy: what it does, its results, and the commands to use it."""

    name: tyro.conf.Positional[str]
    """Name of a task or policy, or folder of a policy; `jumper list` shows the names. Where both have the same name,
    vertical-jump is the task and vertical_jump the policy."""
    task: bool = False  # Describe the task, also where a policy has the same name
    json: bool = False  # Print JSON


def run(args: Sequence[str], modules: Sequence[ModuleType] = ()) -> None:
    """Print the description of a task or a policy; modules: loaded by --task-module, with their tasks registered.

    Raises InputError: there is no such task or policy, or it cannot be read.
    """
    cfg = parse(InfoCfg, "info", args)
    from jumper_warp.policies.catalog import find_policy, summarise
    from jumper_warp.registry import task_name
    from jumper_warp.utils.assets import policy_tasks

    task = task_name(cfg.name)
    if cfg.task or (task is not None and cfg.name not in policy_tasks()):
        content, lines = task_info(cfg.name, modules)
    else:
        summary = summarise(find_policy(cfg.name))
        content, lines = policy_info(summary)
    print(json.dumps(content, indent=2) if cfg.json else "\n".join(lines))


def policy_info(policy: PolicySummary) -> tuple[Json, list[str]]:
    """Return the description of a policy as JSON data and as lines of text."""
    from jumper_warp.policies.catalog import PICTURE
    from jumper_warp.utils.assets import POLICIES, policy_tasks

    name = policy.name if policy.folder.parent == POLICIES else _shown(policy.folder)
    picture = policy.folder / PICTURE
    content = describe(policy) | {"about": policy.about, "rows": policy.rows}
    content["picture"] = str(picture) if picture.is_file() else None
    lines = [f"{policy.name}: policy for the task {policy.task}", ""]
    lines += [*textwrap.wrap(policy.about, WIDTH), ""] if policy.about else []
    lines += [*results_table(policy.rows), ""] if policy.rows else []
    last = {
        "folder": f"{_shown(policy.folder)}, network {size_text(policy.size_bytes)}",
        "picture": _shown(picture) if picture.is_file() else "",
        "play": f"jumper play {name}", "evaluate": f"jumper evaluate {name}",
        "task": f"jumper info {policy.task}" + " --task" * (policy.task in policy_tasks()),
    }  # fmt: skip
    return content, lines + [f"{title:<{INDENT}}{text}" for title, text in last.items() if text]


def _shown(path: Path) -> str:
    """Return a path relative to the working directory if it lies in it, else absolute."""
    try:
        relative = os.path.relpath(path)
    except FileNotFoundError:  # the working directory was deleted
        return str(path)
    return str(Path(path).resolve()) if relative.startswith("..") else relative


def results_table(rows: Sequence[Mapping[str, Any]]) -> list[str]:
    """Return a table of a policy's results as lines of text: one for each test condition, with its first seed.

    Tests with other commands than the first row's are left out. rows: as in the policy's metrics.json.
    """
    commands = rows[0]["conditions"].get("commands")
    rows = [row for row in rows if row["conditions"].get("commands") == commands]
    first = {row["condition"]: row for row in reversed(rows)}
    shown = [row for row in rows if first[row["condition"]] is row]
    from rich.table import Column, Table

    columns = {title: key for title, key in COLUMNS.items() if key in shown[0]["metrics"]}
    table = Table("condition", *(Column(title, justify="right") for title in columns), box=None, pad_edge=False)
    for row in shown:
        cells = (_cell(key, row["metrics"].get(key)) for key in columns.values())
        table.add_row(row["condition"].replace("_", " "), *cells)
    trials = {max(metric["trials"] or 0 for metric in row["metrics"].values()) for row in shown}
    counts = " or ".join(f"{count:,}" for count in sorted(trials))
    notes = [f"{counts} trials a line" + (f"; commands: {commands}" if commands else "")]
    if any("mujoco" in row["condition"] for row in shown):
        notes.append("mujoco: on Newton's SolverMuJoCo; all others on SolverJumper")
    return [*table_lines(table), *notes]


def _cell(key: str, metric: Mapping[str, Any] | None) -> str:
    """Format a metric as a cell of a table: a rate in per cent, else the value with its unit; empty if undefined."""
    if metric is None or metric["value"] is None:
        return ""
    if type(metric["value"]) not in (int, float):
        return str(metric["value"])
    if key.endswith("_rate"):
        return f"{100.0 * metric['value']:.1f} %"
    return f"{metric['value']:#.3g} {metric['unit']}"


def properties(values: Mapping[str, str]) -> list[str]:
    """Format named values as wrapped lines of text, each name before its value; empty values are left out."""
    lines = []
    for name, value in values.items():
        wrapped = textwrap.wrap(value, WIDTH - INDENT, break_long_words=False, break_on_hyphens=False)
        lines += [f"{'' if i else name:<{INDENT}}{text}" for i, text in enumerate(wrapped)]
    return [line.replace(UNBROKEN, " ") for line in lines]


def task_info(name: str, modules: Sequence[ModuleType] = ()) -> tuple[Json, list[str]]:
    """Return the description of a task as JSON data and as lines of text.

    modules: loaded by --task-module, for the printed `jumper train` command.
    Raises InputError: it is unknown, invalid, or cannot be saved.
    """
    from jumper_warp.cli.train import command_line
    from jumper_warp.registry import find_task, first_sentence
    from jumper_warp.tasks.saving import task_to_json
    from jumper_warp.utils.assets import policy_tasks

    name, entry = find_task(name)
    task = entry.task(name)
    task_to_json(task)  # raises TaskError, as in a training
    content = {
        "name": name, "about": entry.description, "details": first_sentence(entry.factory().__doc__ or ""),
        "policies": [policy for policy, of in policy_tasks().items() if of == name], "aliases": list(entry.aliases),
        "module": entry.origin, **contents_of(task),
    }  # fmt: skip
    sizes, rewards = content["observation_sizes"], content["rewards"]
    lines = [f"{name}: {entry.description}" if entry.description else name, ""]
    if content["details"] not in ("", entry.description):
        lines += [*textwrap.wrap(f"{content['details']}.", WIDTH), ""]
    lines += properties(
        {
            "observation": f"{sizes['actor']} numbers: {', '.join(content['observations'])}",
            "critic": f"observes {sizes['critic']} numbers",
            "action": f"{content['action_size']} motor angles",
            "rewards": ", ".join(f"{term}{UNBROKEN}{weight:g}" for term, weight in rewards.items()),
            "terminations": ", ".join(content["terminations"]),
            "policies": ", ".join(content["policies"]),
            "aliases": ", ".join(entry.aliases),
            "module": entry.origin,
            "train": command_line([name], modules).replace(" ", UNBROKEN),
            "presets": ", ".join(f"--preset {preset}" for preset in entry.presets),
        }
    )
    return content, lines


def contents_of(task: TaskCfg) -> Json:
    """Return a task's observation and action sizes, observations, reward weights and terminations as JSON data."""
    return {
        "observation_sizes": {
            group: max((end for _, end in task.layout(group).values()), default=0) for group in ("actor", "critic")
        },
        "observations": [term.name for term in task.observations.actor],
        "action_size": 12,
        "rewards": {term.name: term.numbers["weight"] for term in task.rewards},
        "terminations": [*task.termination_names],
    }
