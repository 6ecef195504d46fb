"""Train the paper's tasks with and without each of the paper's three techniques, test the policies, and write metrics.

    python experiments/paper_trainings.py --tasks vertical-jump-paper --arms full --seeds 0 --out outputs/paper
    python experiments/paper_trainings.py --table --out outputs/paper     # table and curves so far

An arm is a task, an ablation and a seed. Its folder in `--out` has the training and `metrics.json`. Before the training
this file names the primary metrics, with no values: the success of nominal robots over the paper's range at the end,
and the number of policy steps to 50 % success. A success is a jump within 0.1 m of its goal, as in the paper. For
walking it is the tracking error ahead in a written sequence of commands.

A finished arm is skipped, and an interrupted training continues at its last checkpoint. Several processes may train
different arms in one folder. `full` is the task; `no_initialisation` starts in the default pose; `no_estimates` has
neither rewards nor terminations of predicted jumps; `no_curriculum` begins at the last level. Walking has `full` only.
"""

from __future__ import annotations

import shlex
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from jumper_warp.policies.conditions import Conditions
from jumper_warp.registry import make_task
from jumper_warp.rl.resume import CHECKPOINTS
from jumper_warp.utils.errors import InputError
from jumper_warp.utils.output import read_values, write_metrics
from support.paper_runs import (
    ARMS,
    FULL,
    NOMINAL,
    PRIMARY,
    RATE,
    arm_flags,
    evaluate_arm,
    learning_curve,
    train_arm,
    training_metrics,
)
from support.paper_table import plot_curves, results_table
from support.scripts import ThreadArgs, announce, prepare, run_script, tracked

STEPS = f"steps_to_{100 * RATE:g}_percent"
PAPER_TASKS = ("vertical-jump-paper", "horizontal-jump-paper", "velocity-paper")


@dataclass(frozen=True)
class Args(ThreadArgs):
    """Flags of the trainings of the paper's tasks."""

    tasks: tuple[str, ...] = PAPER_TASKS  # Names of tasks
    arms: tuple[str, ...] = ARMS  # Ablations to train
    seeds: tuple[int, ...] = (0, 1, 2, 3, 4)  # Seeds of the trainings
    num_jumps: int = 200  # Number of jumps, or of walks, of a test
    save_interval: int = 100  # Number of iterations between two points of the learning curve
    train_flags: str = ""  # More flags of `jumper train`: --train-flags="--max-iterations 10 --num-envs 64"
    table: bool = False  # Print the table and plot the curves of --out, and train nothing

    def __post_init__(self) -> None:
        if unknown := set(self.arms) - set(ARMS):
            raise InputError(f"arms are {', '.join(ARMS)}, not {min(unknown)}")
        if self.num_jumps < 1 or self.save_interval < 1 or min(self.seeds, default=0) < 0:
            raise InputError("num_jumps and save_interval must be at least 1, seeds at least 0")

    def trainings(self) -> Iterator[tuple[str, str, int]]:
        """Yield (task, ablation or "full", seed) of each training: all trainings with the first seed, then the next."""
        for seed in self.seeds:
            for name in self.tasks:
                walks = make_task(name).evaluation.kind == "velocity"
                yield from ((name, arm, seed) for arm in self.arms if arm == FULL or not walks)

    def command(self, name: str, arm: str, seed: int, folder: Path) -> list[str]:
        """Return the arguments of `jumper train` for a task, an ablation (arm) and a seed; folder: root of the logs."""
        flags = f"--seed {seed} --save-interval {self.save_interval} --max-checkpoints 1000 --no-tensorboard"
        flags += "" if self.device is None else f" --device {self.device}"
        flags += "" if self.threads is None else f" --threads {self.threads}"
        return [name, *shlex.split(f"{flags} {self.train_flags}"), *arm_flags(make_task(name), arm),
                "--log-root", str(folder)]  # fmt: skip


def run_arm(args: Args, name: str, arm: str, seed: int, folder: Path) -> dict[str, Any]:
    """Train and test a task with an ablation (arm) and a seed, unless `folder` has the results; return them by name."""
    primary = f"{NOMINAL}_{PRIMARY[make_task(name).evaluation.kind]}"
    jumps = not primary.startswith(f"{NOMINAL}_walk")
    if (folder / "metrics.json").exists() and (values := read_values(folder)).get(primary) is not None:
        return values
    folder.mkdir(parents=True, exist_ok=True)
    command = args.command(name, arm, seed, folder / "runs")
    plan: dict[str, Any] = {"task": name, "arm": arm, "seed": seed, "flags": shlex.join(command[1:-2])}
    plan["primary"] = [primary, STEPS] if jumps else [primary]
    write_metrics(folder, dict.fromkeys(plan["primary"]), plan)
    run, samples = train_arm(command)
    conditions = Conditions(device=args.device, threads=args.threads)
    curve = learning_curve(run, args.num_jumps, conditions)
    steps = [samples * iteration for iteration in curve["iterations"]]
    values: dict[str, Any] = {"curve_steps": steps, "curve_values": curve["values"], **training_metrics(run)}
    if jumps:
        reached = (step for step, value in zip(steps, curve["values"], strict=True) if value >= RATE)
        values[STEPS] = next(reached, None)
    checkpoint = sorted((run / CHECKPOINTS).glob("iteration_*.pt"))[-1]
    values |= evaluate_arm(checkpoint, folder, args.num_jumps, conditions)
    write_metrics(folder, values, plan)
    return read_values(folder)


def main(args: Args) -> dict[str, Any]:
    """Run and test all trainings in turn, print a table, plot learning curves; return the primary metric of each."""
    folder, results = prepare("paper_trainings", args, args.threads), {}
    for name, arm, seed in [] if args.table else tracked([*args.trainings()], "arms"):
        values = run_arm(args, name, arm, seed, folder / name / f"{arm}_{seed}")
        key = f"{NOMINAL}_{PRIMARY[make_task(name).evaluation.kind]}"
        results[f"{name}_{arm}_{seed}"] = values[key]
        announce(f"{name}, {arm}, seed {seed}: {key.replace('_', ' ')} {values[key]:.3g}")
    plot_curves(folder, folder / "curves.webp")
    print(results_table(folder), end="")
    return results


if __name__ == "__main__":
    run_script(main, Args)
