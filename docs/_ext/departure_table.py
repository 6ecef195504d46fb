"""Table of all numbers of the project's tasks beside the paper's: `docs/results/departures.csv`.

    python docs/_ext/departure_table.py

writes the present numbers of the tasks into the file, and keeps its sources and reasons. A row with another value than
the paper's needs a reason, and a value of the paper its source: P (paper), A (authors' code) or R (our reading).
"""

from __future__ import annotations

import csv
import dataclasses
from pathlib import Path
from typing import Any

import warp as wp

from jumper_warp.registry import find_task, make_task
from jumper_warp.tasks.cfg import TaskCfg
from jumper_warp.tasks.terms import REQUIRED, Term

FILE = Path(__file__).parents[1] / "results" / "departures.csv"
COLUMNS: list[str] = ["task", "name", "ours", "paper", "source", "reason"]
ABSENT = "none"  # Cell of a term or setting that a task lacks
PAPERS = {"vertical-jump": "vertical-jump-paper", "horizontal-jump": "horizontal-jump-paper",
          "velocity-flat": "velocity-paper"}  # fmt: skip
"""The paper's task by our task."""
BASES = {
    "horizontal-jump-sighted": "horizontal-jump", "vertical-jump-standing": "vertical-jump",
    "horizontal-jump-standing": "horizontal-jump", "vertical-jump-mars": "vertical-jump",
    "vertical-jump-mars-loose": "vertical-jump-mars", "horizontal-jump-mars": "horizontal-jump",
    "horizontal-jump-mars-loose": "horizontal-jump-mars", "velocity-rough": "velocity-flat",
    "velocity-mars": "velocity-rough", "velocity-trot": "velocity-flat", "attitude": "",
}  # fmt: skip
"""Task whose numbers a variant has, except in its own rows; empty: none."""
TRAINING = ("num_envs", "max_iterations", "ppo")
SKIPPED = ("name", "state", "command", "metrics", "evaluation", "ppo.tf32", "ppo.graphs",
           "ppo.fused")  # fmt: skip
"""Settings without an effect on what is learnt."""


def text(value: Any) -> str:
    """Return a number, choice, range or group of settings as text."""
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, int):
        return str(value)
    if isinstance(value, float):
        return f"{value + 0.0:.6g}"  # + 0: -0 is 0
    if isinstance(value, tuple):
        return " to ".join(map(text, value)) if len(value) == 2 else " / ".join(map(text, value))
    if dataclasses.is_dataclass(value):
        parts = ((spec.name, getattr(value, spec.name)) for spec in dataclasses.fields(value))
        return ", ".join(f"{name} {text(part)}" for name, part in parts)
    return ABSENT if value is None else str(value)


def term_text(term: Term) -> str:
    """Return the numbers of a reward or other term as text, without defaults, and whether its form is the paper's."""
    kind = type(term)
    values = {key: value for key, value in term.numbers.items() if value != kind.settings.get(key, REQUIRED)}
    values |= {key: option for key, option in term.options.items()
               if option != kind.options[key] and not isinstance(option, wp.Function)}  # fmt: skip
    form = ["the paper's form"] if term.func.func.__module__.endswith(".paper") else []
    return ", ".join([*(f"{key} {text(value)}" for key, value in values.items()), *form]) or "yes"


def settings(value: Any, where: str) -> dict[str, str]:
    """Return a field of a task, such as `rewards`, as text by the dotted names of its settings."""
    if isinstance(value, tuple) and value and all(isinstance(part, Term) for part in value):
        return {f"{where}.{part.name}": term_text(part) for part in value}
    if isinstance(value, tuple) and value and all(dataclasses.is_dataclass(part) for part in value):
        return {f"{where}.{i}": text(part) for i, part in enumerate(value)}
    if isinstance(value, Term):
        return {where: term_text(value)}
    if dataclasses.is_dataclass(value):
        parts = {spec.name: getattr(value, spec.name) for spec in dataclasses.fields(value)}
        return {name: cell for key, part in parts.items() for name, cell in settings(part, f"{where}.{key}").items()}
    plain = value is None or isinstance(value, bool | int | float | str | tuple)
    return {where: text(value)} if plain and value != () else {}


def numbers(name: str, task: TaskCfg | None = None) -> dict[str, str]:
    """Return all numbers, ranges and choices of a task and its training as text by dotted name.

    task: a changed task (default: the registered one).
    """
    task, training = task or make_task(name), find_task(name)[1].training(name)
    parts = {spec.name: getattr(task, spec.name) for spec in dataclasses.fields(task)}
    parts["reset"] = task.reset.settings
    parts |= {key: getattr(training, key) for key in TRAINING}
    parts = {key: part for key, part in parts.items() if key not in SKIPPED}
    cells = {name: cell for key, part in parts.items() for name, cell in settings(part, key).items()}
    return {name: cell for name, cell in cells.items() if name not in SKIPPED}


def rows_of(name: str, task: TaskCfg | None = None) -> dict[str, tuple[str, str]]:
    """Return (our value, the paper's value) of the settings of a task as text by dotted name.

    A task without a task of the paper has only the settings unlike its base's, with empty second texts. task: as in
    `numbers`.
    """
    ours = numbers(name, task)
    other = numbers(PAPERS[name]) if name in PAPERS else numbers(BASES[name]) if BASES[name] else {}
    keys = dict.fromkeys([*ours, *other])
    pairs = {key: (ours.get(key, ABSENT), other.get(key, ABSENT)) for key in keys}
    if name in PAPERS:
        return pairs
    return {key: (mine, "") for key, (mine, base) in pairs.items() if mine != base or not BASES[name]}


def read(path: Path = FILE) -> list[dict[str, str]]:
    """Return the rows of `departures.csv`, cells by column."""
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


def main() -> None:
    """Write the tasks' present numbers into `departures.csv`; sources, reasons and values of other papers stay."""
    old = {(row["task"], row["name"]): row for row in read()} if FILE.exists() else {}
    with FILE.open("w", newline="") as file:
        writer = csv.DictWriter(file, COLUMNS, lineterminator="\n")
        writer.writeheader()
        for task in (*PAPERS, *BASES):
            for name, (ours, paper) in rows_of(task).items():
                kept = old.get((task, name), {})
                values = {"ours": ours, "paper": paper or kept.get("paper", "")}
                writer.writerow({"task": task, "name": name, **values,
                                 "source": kept.get("source", ""), "reason": kept.get("reason", "")})  # fmt: skip


if __name__ == "__main__":
    main()
