"""Evaluation: many jumps at once, each from standing still, to heights or to places as the policy's task has it."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import tyro
from rich.console import Console
from rich.table import Table

from jumper_warp.evaluation.jumps import Figures, JumpLog, Jumps, jump_figures, rule_names, run, within
from jumper_warp.evaluation.landings import Landings, ends_of_a_test, landing_figures, random_headings
from jumper_warp.policies.folder import add_files, find_policy
from jumper_warp.policies.restore import Conditions, env_of_policy, is_run, open_policy
from jumper_warp.policies.spec import PolicyError
from jumper_warp.tasks.cfg import TaskCfg
from jumper_warp.utils.output import output_dir, write_figures

Pair = tuple[float, float]


@dataclass(frozen=True)
class HeightFlags:
    """What vertical jumps are asked for."""

    lower: float | None = None
    """[m] Lowest commanded base height; vertical jumps only, like the next (default: 0.5)."""
    upper: float | None = None
    """[m] Highest (default: 1.2)."""

    def __post_init__(self) -> None:
        """Raises ValueError: a height is out of range."""
        heights = [height for height in (self.lower, self.upper) if height is not None]
        if heights != sorted(heights) or not all(0.0 < height < 10.0 for height in heights):
            raise ValueError(f"heights must be in (0, 10) m and rise, got {self.lower}, {self.upper}")

    def log(self, count: int, rules: tuple[str, ...], seed: int) -> Jumps:
        """Return jumps to evenly spaced heights."""
        return Jumps(np.linspace(self.lower, self.upper, count), rules)


@dataclass(frozen=True)
class PlaceFlags:
    """What jumps to places are asked for."""

    x: Pair | None = None
    """[m] Goals ahead, evenly spaced between these; horizontal jumps only, like the next two (default: 0.3 1.5, for
    omnidirectional jumps -0.7 0.7)."""
    y: Pair | None = None
    """[m] Goals to the left, drawn between these (default: 0 0, for omnidirectional jumps -0.7 0.7)."""
    heading: Literal["any"] | float | None = None
    """[deg] Heading of all robots, or any: drawn from the full circle (default: any)."""

    def __post_init__(self) -> None:
        """Raises ValueError: a range is not one."""
        for name in ("x", "y"):
            pair = getattr(self, name)
            if pair is not None and not -10.0 < pair[0] <= pair[1] < 10.0:
                raise ValueError(f"{name} must be in (-10, 10) m and rise, got {pair[0]}, {pair[1]}")
        if self.heading not in (None, "any") and not math.isfinite(self.heading):
            raise ValueError(f"heading must be finite or any, got {self.heading}")

    def log(self, count: int, rules: tuple[str, ...], seed: int) -> Landings:
        """Return single jumps with these goals and headings."""
        rng = np.random.default_rng(seed)
        goals = np.stack([np.linspace(*self.x, count), rng.uniform(*self.y, count)], axis=1)
        headings = random_headings(count, seed) if self.heading == "any" else math.radians(self.heading)
        return Landings(goals[:, None], rules, headings)


def place_figures(landings: Landings, in_range: Pair) -> Figures:
    """Return the figures of jumps to places; in_range [m]: distances of the goals that count as in range."""
    inside = within(np.linalg.norm(landings.goals, axis=-1), in_range)
    return landing_figures(landings, inside) | {"range_lower_m": in_range[0], "range_upper_m": in_range[1]}


@dataclass(frozen=True)
class Measure:
    """How policies of a task are measured."""

    flags: HeightFlags | PlaceFlags
    """What is asked for unless told otherwise."""
    in_range: Pair
    """[m] Targets that the success rate in range counts, unless told otherwise."""
    figures: Callable[[Any, Pair], Figures]
    change: Callable[[TaskCfg], TaskCfg] | None = None
    """Returns the task with the ends of a jump that count here."""


MEASURES = {
    "vertical-jump": Measure(HeightFlags(0.5, 1.2), (0.5, 1.1), jump_figures),
    "horizontal-jump": Measure(PlaceFlags((0.3, 1.5), (0.0, 0.0), "any"), (0.3, 1.4), place_figures, ends_of_a_test),
    "omnidirectional-jump": Measure(
        PlaceFlags((-0.7, 0.7), (-0.7, 0.7), "any"), (0.0, 0.7), place_figures, ends_of_a_test
    ),
}


@dataclass(frozen=True)
class EvaluateCfg:
    """Let a policy jump many times and report how well it did."""

    policy: tyro.conf.Positional[str]
    """Name or folder of a policy, a run's folder, or a checkpoint."""
    jumps: int = 200
    """Number of jumps."""
    heights: Annotated[HeightFlags, tyro.conf.arg(name="")] = field(default_factory=HeightFlags)
    """For vertical jumps."""
    places: Annotated[PlaceFlags, tyro.conf.arg(name="")] = field(default_factory=PlaceFlags)
    """For jumps to places."""
    in_range: Pair | None = None
    """[m] Heights, or distances, that the success rate in range counts (default: 0.5 1.1 for vertical jumps, 0.3 1.4
    for horizontal and 0 0.7 for omnidirectional ones)."""
    conditions: Annotated[Conditions, tyro.conf.arg(name="")] = field(default_factory=Conditions)
    """What the policy is tried in."""
    out: Path | None = None
    """Folder for figures.json and jumps.csv (default: outputs/evaluate/<time>)."""
    keep: bool = False
    """Also put the figures into the policy's folder."""

    def __post_init__(self) -> None:
        """Raises ValueError: a setting is out of range."""
        if self.jumps < 1:
            raise ValueError(f"jumps must be at least 1, got {self.jumps}")
        if self.in_range is not None and not 0.0 <= self.in_range[0] <= self.in_range[1] < 10.0:
            raise ValueError(f"in_range must be in [0, 10) m and rise, got {self.in_range[0]}, {self.in_range[1]}")


def evaluate(cfg: EvaluateCfg) -> dict[str, Any]:
    """Evaluate, print a table, write `figures.json` and `jumps.csv`, and return the figures.

    Raises:
        PolicyError: The policy cannot be used, its task has no measure, or a flag is not for its task.
        CheckpointError: The checkpoint cannot be used.
        OSError: The folder cannot be made.
    """
    policy = open_policy(cfg.policy)
    task = policy.interface.task
    measure = measure_of(task)
    flags = flags_for(task, measure.flags, cfg.heights, cfg.places)
    if cfg.keep and is_run(cfg.policy):
        raise PolicyError(f"{cfg.policy}: a run keeps no figures; export it first")
    folder = output_dir("evaluate", cfg.out)
    env = env_of_policy(policy, cfg.jumps, cfg.conditions, change=measure.change)
    policy.to(env.device)
    log = flags.log(cfg.jumps, rule_names(env), cfg.conditions.seed)
    run(policy.act, env, log)
    figures = {
        "task": task,
        **{name: getattr(cfg.conditions, name) for name in ("solver", "randomize", "noise", "seed")},
        **measure.figures(log, cfg.in_range or measure.in_range),
    }
    write_figures(folder, figures)
    (folder / "jumps.csv").write_text(csv_text(log))
    if cfg.keep:
        keep_figures(cfg.policy, folder)
    print_figures(figures)
    Console(stderr=True).print(f"{folder}/figures.json", highlight=False, soft_wrap=True)
    return figures


def measure_of(task: str) -> Measure:
    """Return how a task is measured. Raises PolicyError for one that is not."""
    if task not in MEASURES:
        raise PolicyError(f"policies of {', '.join(MEASURES)} are evaluated and played, this one is of {task!r:.60}")
    return MEASURES[task]


def flags_for(task: str, default: Any, *groups: Any) -> Any:
    """Return the group of flags that is the default's kind, with the default where nothing was given.

    Raises PolicyError where something was given in another group.
    """
    chosen = default
    for group in groups:
        given = {name: value for name, value in vars(group).items() if value != getattr(type(group)(), name)}
        if isinstance(group, type(default)):
            chosen = type(default)(**(vars(default) | given))
        elif given:
            raise PolicyError(f"--{next(iter(given))} is not for policies of {task}")
    return chosen


def keep_figures(policy: str, folder: Path) -> None:
    """Copy figures, what made them, and the list of jumps from a folder into a policy's."""
    add_files(
        find_policy(policy), {name: (folder / name).read_bytes() for name in ("figures.json", "run.json", "jumps.csv")}
    )


def csv_text(log: JumpLog) -> str:
    """Return a heading and one line a jump: what was asked for, what came of it, and how it ended."""
    columns = log.columns()
    lines = [",".join(columns)]
    for row in zip(*columns.values(), strict=True):
        lines.append(",".join(f"{value:.6f}" if isinstance(value, float) else str(value or "") for value in row))
    return "\n".join(lines) + "\n"


def print_figures(figures: dict[str, Any]) -> None:
    """Print a table of figures to standard output."""
    table = Table("figure", "value", box=None)
    for name, value in figures.items():
        table.add_row(name, f"{value:.4g}" if isinstance(value, float) else json.dumps(value))
    Console().print(table)
