"""Trainings without a departure from the paper, the jumps of their policies, and the report of both."""

from __future__ import annotations

import json
import shlex
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Literal, cast

import numpy as np
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from jumper_warp.cli.train import env_maker, parse_train
from jumper_warp.evaluation.plots import drawn
from jumper_warp.evaluation.run import HEIGHTS, EvaluationRun
from jumper_warp.policies.conditions import Conditions
from jumper_warp.policies.warm_start import start_from
from jumper_warp.registry import make_task
from jumper_warp.rl.resume import CHECKPOINTS
from jumper_warp.rl.runner import CONFIG, train
from jumper_warp.tasks.cfg import TaskCfg
from jumper_warp.tasks.saving import task_to_json
from jumper_warp.utils.errors import InputError
from support.departures import Undone
from support.holds import Holds, hold_goals, hold_metrics

ELSEWHERE = {"log_root", "device", "threads"}
"""Settings in which a training may differ from one that is there already."""
HOLD = 3.0
"""[s]"""
TESTS = ("nominal", "randomized")
KEPT = "kept"
"""Name of the task with all departures."""
COLUMNS = {
    "error [mm]": ("error_m", 1000.0),
    "success [%]": ("success_rate", 100.0),
    "falls [%]": ("fall_rate", 100.0),
    "still [%]": ("still_landing_rate", 100.0),
    "hops again [%]": ("second_takeoff_rate", 100.0),
    "at rest [%]": ("at_rest_within_1_s_rate", 100.0),
    "largest tilt [deg]": ("max_landing_tilt_deg", 1.0),
    "waits [%]": ("holding_rate", 100.0),
    "paw force varies [N]": ("median_paw_force_range_n", 1.0),
    "torque ripple [N m]": ("mean_torque_ripple_nm", 1.0),
}
"""Of the table: metric and scale; nominal / randomised."""
WIDTH = 180
"""Of the table, in characters."""
Found = dict[tuple[str, int], dict[str, dict[str, Any]]]
"""Metrics by training (name, seed) and test."""


@dataclass(frozen=True)
class Jumps:
    """How the departures of a task are measured."""

    iterations: int
    """Of each training."""
    goals: dict[str, Any]
    """[m] Of the jumps."""
    squats: tuple[float, float]
    """[m] Goals for which robots wait."""
    begin: str = ""
    """More flags of each training."""


Jump = Literal["vertical-jump", "horizontal-jump", "omnidirectional-jump", "horizontal-jump-mars-loose"]
JUMPS: dict[Jump, Jumps] = {
    "vertical-jump": Jumps(1000, {"height_range": (0.5, 1.05)}, (0.6, 1.05)),
    "horizontal-jump": Jumps(800, {"goal_x": (0.3, 1.5)}, (0.3, 1.5)),
    "omnidirectional-jump": Jumps(1000, {"goal_x": (-0.8, 1.2), "goal_y": (-0.8, 0.8)}, (0.3, 1.2)),
    "horizontal-jump-mars-loose": Jumps(
        1000, {"goal_x": (0.5, 4.2)}, (0.5, 4.2), "--start-from horizontal_jump --ppo.init-std 0.3"
    ),
}


def settings(undone: Undone, arguments: list[str]) -> tuple[Any, TaskCfg]:
    """Return the settings of `jumper train` with arguments, and its task without a departure."""
    parsed, task = parse_train(arguments)
    return parsed, task if isinstance(undone, str) else undone(task)


def trained(undone: Undone, arguments: list[str]) -> Path:
    """Return the last checkpoint of a training, made unless it is there. Raises InputError: it has other settings."""
    (parsed, task), name = settings(undone, arguments), f"{CHECKPOINTS}/iteration_{{:06d}}.pt"
    if found := sorted(Path(parsed.cfg.log_root).glob(f"*/*/{name.format(parsed.cfg.max_iterations)}")):
        config = json.loads((found[-1].parents[1] / CONFIG).read_text())
        wanted = json.loads(json.dumps(asdict(parsed.cfg), default=str))
        other = {key for key in wanted.keys() - ELSEWHERE if wanted[key] != config["train"].get(key)}
        if other or config["env"]["task"] != task_to_json(task):
            raise InputError(f"{found[-1].parents[1]} was trained with other settings: choose another --out")
        return found[-1]
    start = start_from(parsed.cfg.start_from, task, parsed.cfg.ppo) if parsed.cfg.start_from else None
    typed = shlex.join(["jumper", "train", *arguments])
    result = train(parsed.cfg, env_maker(task, parsed), typed, start=start)
    return result.folder / name.format(result.iteration)


def measured(checkpoint: Path, args: Any, folder: Path) -> dict[str, dict[str, Any]]:
    """Return metrics of a policy's jumps and squats by test; args: as `experiments/departures.py` has them."""
    run, ends = EvaluationRun(checkpoint), make_task(args.task).terminations
    run.prepare("departures", Conditions(device=args.device, threads=args.threads), folder)
    tests = {}
    for test, count in zip(TESTS, args.num_jumps, strict=True):
        drawn_robots = test == "randomized"
        conditions = replace(run.conditions, randomize=drawn_robots, noise=drawn_robots)
        flags: Any = replace(cast(Any, run.evaluation.flags), num_jumps=count, **JUMPS[args.task].goals)
        env = run.env(count, lambda task: run.evaluation.for_evaluation(replace(task, terminations=ends)), conditions)
        values = flags.metrics(run.follow(env, flags.log(env.task, 0)))
        values["error_m"] = values.get("mean_abs_error_m", values.get("mean_error_m"))
        goals = hold_goals(args.num_squats, JUMPS[args.task].squats, up=run.task.evaluation in HEIGHTS)
        values |= hold_metrics(run.follow(run.env(args.num_squats, conditions=conditions), Holds(goals, HOLD)))
        tests[test] = {name: value for name, value in values.items() if isinstance(value, bool | int | float | None)}
    return tests


def report(found: Found, title: str, folder: Path) -> Table:
    """Write table and plot into a folder, and return the table."""
    table = Table("undone, seed", *map(escape, COLUMNS), title=title)
    for (name, seed), tests in found.items():
        table.add_row(f"{name.replace('_', ' ')}, {seed}", *(cell(tests, *column) for column in COLUMNS.values()))
    with (folder / "departures.txt").open("w") as file:
        Console(file=file, width=WIDTH).print(table)
    plot(found, folder / "departures.png")
    return table


def cell(tests: dict[str, dict[str, Any]], name: str, scale: float) -> str:
    """Return a metric of both tests as the table has it."""
    found = (tests[test][name] for test in TESTS)
    return " / ".join("-" if value is None else f"{scale * value:.3g}" for value in found)


def plot(found: Found, path: Path) -> None:
    """Draw success and error of each training, the task with all departures as lines."""
    rows = [*found]
    with drawn(path, 1, 2, figsize=(11, 1.0 + 0.25 * len(rows)), sharey=True) as axes:
        for axis, name, scale in zip(axes, ("success_rate", "error_m"), (100.0, 1000.0), strict=True):
            for test, marker in zip(TESTS, "ox", strict=True):
                x = [np.nan if (v := found[row][test][name]) is None else scale * v for row in rows]
                axis.plot(x, range(len(rows)), marker, label=test)
                for value in (x[i] for i, (row, _) in enumerate(rows) if row == KEPT):
                    axis.axvline(value, color="0.8", linewidth=0.8, zorder=0)
        axes[0].set(xlabel="success [%]", yticks=range(len(rows)))
        axes[0].set_yticklabels([f"{name.replace('_', ' ')}, {seed}" for name, seed in rows])
        axes[0].invert_yaxis()
        axes[1].set(xlabel="mean error [mm]")
        axes[1].legend()
