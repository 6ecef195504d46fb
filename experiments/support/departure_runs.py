"""Trainings of ablations (tasks with one departure from the paper undone), their evaluation, and the report."""

from __future__ import annotations

import io
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
from jumper_warp.evaluation.run import HEIGHTS, EvaluationRun
from jumper_warp.policies.conditions import Conditions
from jumper_warp.policies.warm_start import actor_init_from_policy
from jumper_warp.registry import make_task
from jumper_warp.rl.resume import CHECKPOINTS
from jumper_warp.rl.run_names import newest
from jumper_warp.rl.runner import CONFIG, train
from jumper_warp.tasks.cfg import TaskCfg
from jumper_warp.tasks.saving import task_to_json
from jumper_warp.utils.errors import InputError
from jumper_warp.utils.files import write_atomically
from jumper_warp.viz.plots import figure
from support.departures import Ablation
from support.squats import SquatLog, squat_goals, squat_metrics

NOT_COMPARED = {"log_root", "device", "threads"}  # Settings in which a training may differ from a saved one
HOLD = 3.0  # [s] Time for which squats are held
TESTS = ("nominal", "randomized")  # Robots of the evaluations
BASELINE = "kept"  # Name of the training with all departures
COLUMNS = {
    "error [mm]": ("error_m", 1000.0), "success [%]": ("success_rate", 100.0), "falls [%]": ("fall_rate", 100.0),
    "still [%]": ("no_paw_lift_rate", 100.0), "hops again [%]": ("second_takeoff_rate", 100.0),
    "at rest [%]": ("at_rest_rate", 100.0), "largest tilt [deg]": ("landing_tilt_max_deg", 1.0),
    "waits [%]": ("holding_rate", 100.0), "paw force varies [N]": ("paw_force_range_median_n", 1.0),
    "torque ripple [N m]": ("torque_ripple_mean_nm", 1.0),
}  # fmt: skip
"""Columns of the table: metric and scale; cells are nominal / randomised."""
WIDTH = 180  # Width of the table in characters
MetricsByTraining = dict[tuple[str, int], dict[str, dict[str, Any]]]  # Metrics by training (name, seed), test and name


@dataclass(frozen=True)
class DepartureCfg:
    """Settings with which the ablations of a task are trained and evaluated."""

    iterations: int  # Iterations of each training
    goals: dict[str, Any]  # [m] Flags that set the goals of the evaluated jumps
    squats: tuple[float, float]  # [m] Range of goals for which squats are held
    begin: str = ""  # Further flags of `jumper train` for every training


JumpTask = Literal["vertical-jump", "horizontal-jump", "omnidirectional-jump", "horizontal-jump-mars-loose"]
JUMP_TASKS: dict[JumpTask, DepartureCfg] = {
    "vertical-jump": DepartureCfg(1000, {"height_range": (0.5, 1.05)}, (0.6, 1.05)),
    "horizontal-jump": DepartureCfg(800, {"goal_x": (0.3, 1.5)}, (0.3, 1.5)),
    "omnidirectional-jump": DepartureCfg(1000, {"goal_x": (-0.8, 1.2), "goal_y": (-0.8, 0.8)}, (0.3, 1.2)),
    "horizontal-jump-mars-loose": DepartureCfg(
        1000, {"goal_x": (0.5, 4.2)}, (0.5, 4.2), "--init-policy horizontal_jump --ppo.init-std 0.3"
    ),
}


def parse(ablation: Ablation, arguments: list[str]) -> tuple[Any, TaskCfg]:
    """Parse the arguments of `jumper train`: return the settings, and the task with an ablation."""
    parsed, task = parse_train(arguments)
    return parsed, task if isinstance(ablation, str) else ablation(task)


def train_or_load(ablation: Ablation, arguments: list[str]) -> Path:
    """Return the last checkpoint of a training, and run the training unless the checkpoint exists.

    arguments: of `jumper train`. Raises InputError: the existing training has other settings.
    """
    (parsed, task), name = parse(ablation, arguments), f"{CHECKPOINTS}/iteration_{{:06d}}.pt"
    last = name.format(parsed.cfg.max_iterations)
    if run := newest(path.parents[1] for path in Path(parsed.cfg.log_root).glob(f"*/*/{last}")):
        config = json.loads((run / CONFIG).read_text())
        requested = json.loads(json.dumps(asdict(parsed.cfg), default=str))
        changed = {key for key in requested.keys() - NOT_COMPARED if requested[key] != config["train"].get(key)}
        if changed or config["env"]["task"] != task_to_json(task):
            raise InputError(f"{run} was trained with other settings: choose another --out")
        return run / last
    start = actor_init_from_policy(parsed.cfg.init_policy, task, parsed.cfg.ppo) if parsed.cfg.init_policy else None
    command = shlex.join(["jumper", "train", *arguments])
    result = train(parsed.cfg, env_maker(task, parsed), command, actor_init=start)
    return result.folder / name.format(result.iteration)


def evaluate(checkpoint: Path, args: Any, folder: Path) -> dict[str, dict[str, Any]]:
    """Evaluate a policy's jumps and held squats: return the scalar metrics by name, for each of TESTS.

    args: `Args` of `experiments/departures.py`; folder: for outputs of the run.
    """
    run, ends = EvaluationRun(checkpoint), make_task(args.task).terminations
    run.prepare("departures", Conditions(device=args.device, threads=args.threads), folder)
    tests = {}
    for test, count in zip(TESTS, args.num_jumps, strict=True):
        randomize = test == "randomized"
        conditions = replace(run.conditions, randomize=randomize, noise=randomize)
        flags: Any = replace(cast(Any, run.evaluation.flags), num_jumps=count, **JUMP_TASKS[args.task].goals)
        env = run.env(count, lambda task: run.evaluation.prepare_task(replace(task, terminations=ends)), conditions)
        values = flags.metrics(run.run_episodes(env, flags.log(env.task, 0)))
        up = run.task.evaluation_suite in HEIGHTS
        values["error_m"] = values["apex_error_abs_mean_m" if up else "goal_distance_at_end_mean_m"]
        goals = squat_goals(args.num_squats, JUMP_TASKS[args.task].squats, up=up)
        values |= squat_metrics(
            run.run_episodes(run.env(args.num_squats, conditions=conditions), SquatLog(goals, HOLD))
        )
        tests[test] = {key: metric.value for key, metric in values.items()}
    return tests


def write_table(results: MetricsByTraining, title: str, folder: Path) -> None:
    """Write the results of all ablations into a folder, as table `departures.txt` and plot `departures.png`."""
    table = Table("ablation, seed", *map(escape, COLUMNS), title=title)
    for (name, seed), tests in results.items():
        table.add_row(f"{name.replace('_', ' ')}, {seed}", *(cell(tests, *column) for column in COLUMNS.values()))
    text = io.StringIO()
    Console(file=text, width=WIDTH).print(table)
    write_atomically(folder / "departures.txt", text.getvalue().encode())
    plot_results(results, folder / "departures.png")


def cell(tests: dict[str, dict[str, Any]], name: str, scale: float) -> str:
    """Format a metric of nominal and randomised jumps for the table, as `nominal / randomized`, times `scale`.

    tests: metrics by test and name.
    """
    values = (tests[test][name] for test in TESTS)
    return " / ".join("-" if value is None else f"{scale * value:.3g}" for value in values)


def plot_results(results: MetricsByTraining, path: Path) -> None:
    """Plot success and error of every ablation's policy; grey lines mark the trainings with all departures."""
    rows = [*results]
    with figure(path, 1, 2, figsize=(11, 2.0 + 0.3 * len(rows)), sharey=True, title="Ablations") as axes:
        for axis, name, scale in zip(axes, ("success_rate", "error_m"), (100.0, 1000.0), strict=True):
            for test, marker in zip(TESTS, "ox", strict=True):
                x = [np.nan if (v := results[row][test][name]) is None else scale * v for row in rows]
                axis.plot(x, range(len(rows)), marker, label=test)
                for value in (x[i] for i, (row, _) in enumerate(rows) if row == BASELINE):
                    axis.axvline(value, color="0.5", linewidth=0.8, zorder=0, label="all departures")
        axes[0].set(xlabel="success [%]", yticks=range(len(rows)))
        axes[0].set_yticklabels([f"{name.replace('_', ' ')}, {seed}" for name, seed in rows])
        axes[0].invert_yaxis()
        axes[1].set(xlabel="mean error [mm]")
