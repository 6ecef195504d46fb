"""What departures of a jump from the paper and its authors' configuration change: trained without each, one at a time.

    python experiments/departures.py --task vertical-jump --out outputs/departures
    python experiments/departures.py --task horizontal-jump --only bracing goals --seeds 1 2

Trainings are alike but for what is undone (`support.departures`): from nothing (on Mars from the policy
of Earth), randomised, as many iterations. The task as it is, `kept`, is trained with every seed of `--kept-seeds`,
which tells how much seeds differ. Each policy then makes 200 nominal and 1000 randomised jumps as `jumper evaluate` has
them, a fall or a touch after the landing being a failure, and 100 robots of each kind wait in their squats for 3 s.
What ends a jump is that of the task as it is, whatever the training had.

A training that `--out` holds already is not made again, so that what was interrupted goes on where it was, and
`--no-measure` may train on one machine what another measures.
"""

from __future__ import annotations

import json
import shlex
from collections.abc import Iterator
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
import tyro
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from jumper_warp.cli.main import run_command
from jumper_warp.cli.train import env_maker, parse_train
from jumper_warp.evaluation.plots import drawn
from jumper_warp.evaluation.run import HEIGHTS, EvaluationRun
from jumper_warp.policies.conditions import Conditions
from jumper_warp.policies.warm_start import start_from
from jumper_warp.registry import make_task
from jumper_warp.rl.resume import CHECKPOINTS
from jumper_warp.rl.runner import CONFIG, train
from jumper_warp.tasks.saving import task_to_json
from jumper_warp.utils.errors import InputError
from jumper_warp.utils.output import output_dir, write_metrics
from jumper_warp.utils.runtime import announce
from support.departures import DEPARTURES, Undone
from support.holds import Holds, hold_goals, hold_metrics

ELSEWHERE = {"log_root", "device", "threads"}
"""Settings that a training need not share with one that is there already."""
KEPT = "kept"
"""Name of the task as it is."""


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
    "vertical-jump": Jumps(1000, {"lower": 0.5, "upper": 1.05}, (0.6, 1.05)),
    "horizontal-jump": Jumps(800, {"x": (0.3, 1.5)}, (0.3, 1.5)),
    "omnidirectional-jump": Jumps(1000, {"x": (-0.8, 1.2), "y": (-0.8, 0.8)}, (0.3, 1.2)),
    "horizontal-jump-mars-loose": Jumps(
        1000, {"x": (0.5, 4.2)}, (0.5, 4.2), "--start-from horizontal_jump --ppo.init-std 0.3"
    ),
}
HOLD = 3.0
"""[s]"""
TESTS = ("nominal", "randomized")
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
"""Of the table: figure and scale; nominal / randomised."""
WIDTH = 180
"""Of the table, in characters."""


@dataclass(frozen=True)
class Args:
    """Flags."""

    task: Jump = "vertical-jump"
    """Whose departures."""
    only: tuple[str, ...] = ()
    """Names of those that are undone (default: all)."""
    iterations: int | None = None
    """Of each training (default: 800 or 1000, when the task as it is has learned)."""
    envs: int = 8192
    """Number of environments."""
    seeds: tuple[int, ...] = (1,)
    """Of the trainings without one of them."""
    kept_seeds: tuple[int, ...] = (1, 2, 3)
    """Of those with all."""
    jumps: tuple[int, int] = (200, 1000)
    """Nominal and randomised."""
    squats: int = 100
    """Robots that wait."""
    train: str = ""
    """More flags of `jumper train`, for all trainings: --train="--ppo.gamma 0.98"."""
    measure: bool = True
    """Make the jumps after each training."""
    out: Path | None = None
    """Folder for runs, figures, table and plot (default: outputs/departures/<time>)."""
    device: str | None = None
    """Warp device."""
    threads: int | None = None
    """CPU threads that share the worlds (default: all cores); they change no result."""

    def __post_init__(self) -> None:
        """Check the values."""
        unknown = set(self.only) - {KEPT, *DEPARTURES[self.task]}
        if unknown:
            raise InputError(f"departures of {self.task} are {', '.join(DEPARTURES[self.task])}, not {min(unknown)}")
        if self.length < 1 or self.envs < 1 or min(self.jumps) < 1 or self.squats < 1:
            raise InputError("iterations, envs, jumps and squats must be at least 1")

    @property
    def length(self) -> int:
        """Iterations of each training."""
        return JUMPS[self.task].iterations if self.iterations is None else self.iterations

    def trainings(self) -> Iterator[tuple[str, int, Undone]]:
        """Yield name, seed, and what is undone."""
        names = self.only or (KEPT, *DEPARTURES[self.task])
        for name in names:
            for seed in self.kept_seeds if name == KEPT else self.seeds:
                yield name, seed, DEPARTURES[self.task].get(name, Undone())

    def command(self, undone: Undone, seed: int, folder: Path) -> list[str]:
        """Return the arguments of `jumper train`."""
        flags = f"--num-envs {self.envs} --iterations {self.length} --seed {seed} --no-tensorboard"
        flags += "" if self.device is None else f" --device {self.device}"
        flags += "" if self.threads is None else f" --threads {self.threads}"
        flags = f"{flags} {JUMPS[self.task].begin} {self.train} {undone.flags}"
        return [self.task, *shlex.split(flags), "--log-root", str(folder)]


def trained(undone: Undone, arguments: list[str]) -> Path:
    """Return the last checkpoint of a training, made unless it is there. Raises InputError: it has other settings."""
    parsed, task = parse_train(arguments)
    task, name = undone.change(task), f"{CHECKPOINTS}/iteration_{{:06d}}.pt"
    if found := sorted(Path(parsed.cfg.log_root).glob(f"*/*/{name.format(parsed.cfg.iterations)}")):
        config = json.loads((found[-1].parents[1] / CONFIG).read_text())
        asked = json.loads(json.dumps(asdict(parsed.cfg), default=str))
        other = {key for key in asked.keys() - ELSEWHERE if asked[key] != config["train"].get(key)}
        if other or config["env"]["task"] != task_to_json(task):
            raise InputError(f"{found[-1].parents[1]} was trained with other settings: choose another --out")
        return found[-1]
    start = start_from(parsed.cfg.start_from, task, parsed.cfg.ppo) if parsed.cfg.start_from else None
    typed = shlex.join(["jumper", "train", *arguments])
    result = train(parsed.cfg, env_maker(task, parsed), typed, start=start)
    return result.folder / name.format(result.iteration)


def measured(checkpoint: Path, args: Args, folder: Path) -> dict[str, dict[str, Any]]:
    """Return figures of a policy's jumps, and of how it waits, by test."""
    run, ends = EvaluationRun(checkpoint), make_task(args.task).terminations
    run.prepare("departures", Conditions(device=args.device, threads=args.threads), folder)
    tests = {}
    for test, count in zip(TESTS, args.jumps, strict=True):
        drawn_robots = test == "randomized"
        conditions = replace(run.conditions, randomize=drawn_robots, noise=drawn_robots)
        flags = replace(run.evaluation.flags, jumps=count, **JUMPS[args.task].goals)
        env = run.env(count, lambda task: run.evaluation.for_evaluation(replace(task, terminations=ends)), conditions)
        values = flags.metrics(run.follow(env, flags.log(env.task, 0)))
        values["error_m"] = values.get("mean_abs_error_m", values.get("mean_error_m"))
        goals = hold_goals(args.squats, JUMPS[args.task].squats, up=run.task.evaluation in HEIGHTS)
        values |= hold_metrics(run.follow(run.env(args.squats, conditions=conditions), Holds(goals, HOLD)))
        tests[test] = {name: value for name, value in values.items() if isinstance(value, bool | int | float | None)}
    return tests


def cell(tests: dict[str, dict[str, Any]], name: str, scale: float) -> str:
    """Return a figure of both tests as the table has it."""
    found = (tests[test][name] for test in TESTS)
    return " / ".join("-" if value is None else f"{scale * value:.3g}" for value in found)


def plot(found: dict[tuple[str, int], dict[str, dict]], path: Path) -> None:
    """Draw randomised success and error of each training, the task as it is as lines."""
    rows = [*found]
    with drawn(path, 1, 2, figsize=(11, 1.0 + 0.25 * len(rows)), sharey=True) as axes:
        for axis, name, scale in zip(axes, ("success_rate", "error_m"), (100.0, 1000.0), strict=True):
            for test, marker in (("nominal", "o"), ("randomized", "x")):
                x = [np.nan if (v := found[row][test][name]) is None else scale * v for row in rows]
                axis.plot(x, range(len(rows)), marker, label=test)
                for value in (x[i] for i, (row, _) in enumerate(rows) if row == KEPT):
                    axis.axvline(value, color="0.8", linewidth=0.8, zorder=0)
        axes[0].set(xlabel="success [%]", yticks=range(len(rows)))
        axes[0].set_yticklabels([f"{name.replace('_', ' ')}, {seed}" for name, seed in rows])
        axes[0].invert_yaxis()
        axes[1].set(xlabel="mean error [mm]")
        axes[1].legend()


def main(args: Args) -> dict[str, Any]:
    """Train and measure each, and return the figures."""
    for name, seed, undone in args.trainings():  # what cannot be is told before any training
        undone.change(parse_train(args.command(undone, seed, Path(name)))[1])
    announce(args.device, args.threads)
    folder = output_dir("departures", args.out)
    table = Table("undone, seed", *map(escape, COLUMNS), title=f"{args.task}, {args.length} iterations")
    values: dict[str, Any] = {"task": args.task, "iterations": args.length, "envs": args.envs}
    found: dict[tuple[str, int], dict[str, dict]] = {}
    for name, seed, undone in args.trainings():
        checkpoint = trained(undone, args.command(undone, seed, folder / f"{name}_{seed}"))
        if not args.measure:
            continue
        tests = found[name, seed] = measured(checkpoint, args, folder)
        values[f"flags_{name}"] = undone.flags
        values |= {f"{test}_{key}_{name}_{seed}": tests[test][key] for test in TESTS for key in tests[test]}
        table.add_row(f"{name.replace('_', ' ')}, {seed}", *(cell(tests, *column) for column in COLUMNS.values()))
        write_metrics(folder, values)
        plot(found, folder / "departures.png")
        with (folder / "departures.txt").open("w") as file:
            Console(file=file, width=WIDTH).print(table)
    if found:
        Console(width=WIDTH).print(table)
    print(f"{'figures, table, plot and ' if found else ''}runs in {folder}")
    return values


if __name__ == "__main__":
    run_command(lambda: main(tyro.cli(Args)))
