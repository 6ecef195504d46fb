"""Train ablations of a jump task, each without one departure from the paper; write metrics, a table, a plot and runs.

    python experiments/departures.py --task vertical-jump --out outputs/departures
    python experiments/departures.py --task horizontal-jump --only bracing goals --seeds 1 2

A departure is a difference of a task from the paper and its authors' configuration (`support.departures`). Trainings
differ only in the departure that is undone. They are equally long, randomised, and start from random weights (on Mars
from the policy of Earth). The task with all departures, `kept`, is trained with each seed of `--baseline-seeds`, to
show the spread between seeds.

Each policy then makes nominal and randomised jumps as in `jumper evaluate`, where a fall or a collision after the
landing is a failure. Nominal and randomised robots also hold their squats for 3 s. The task's terminations end the
jumps, regardless of those of the training. A training that is already in `--out` is loaded, so that an interrupted run
continues. `--no-measure` only trains.
"""

from __future__ import annotations

import shlex
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from jumper_warp.utils.errors import InputError
from jumper_warp.utils.output import write_metrics
from support.departure_runs import BASELINE, JUMP_TASKS, TESTS, JumpTask, evaluate, parse, train_or_load, write_table
from support.departures import DEPARTURES, Ablation, ablation_flags
from support.scripts import ThreadArgs, announce, prepare, report, run_script, tracked


@dataclass(frozen=True)
class Args(ThreadArgs):
    """Flags of the training of ablations of a jump task, each without one departure from the paper."""

    task: JumpTask = "vertical-jump"  # Task whose departures are undone
    only: tuple[str, ...] = ()  # Names of the departures to undo, or kept for none (default: all)
    iterations: int | None = None
    """Iterations of each training (default: 800 or 1000, when the task with all departures has learned)."""
    num_envs: int = 8192  # Number of environments
    seeds: tuple[int, ...] = (1,)  # Seeds of the trainings without one departure
    baseline_seeds: tuple[int, ...] = (1, 2, 3)  # Seeds of the trainings with all departures
    num_jumps: tuple[int, int] = (200, 1000)  # Numbers of nominal and of randomised jumps
    num_squats: int = 100  # Number of robots that hold a squat
    train_flags: str = ""  # More flags of `jumper train`, for all trainings: --train-flags="--ppo.gamma 0.98"
    measure: bool = True  # Make the jumps after each training

    def __post_init__(self) -> None:
        unknown = set(self.only) - {BASELINE, *DEPARTURES[self.task]}
        if unknown:
            raise InputError(f"departures of {self.task} are {', '.join(DEPARTURES[self.task])}, not {min(unknown)}")
        if self.length < 1 or self.num_envs < 1 or min(self.num_jumps) < 1 or self.num_squats < 1:
            raise InputError("iterations, num_envs, num_jumps and num_squats must be at least 1")

    @property
    def length(self) -> int:
        """Number of iterations of each training."""
        return JUMP_TASKS[self.task].iterations if self.iterations is None else self.iterations

    def trainings(self) -> Iterator[tuple[str, int, Ablation]]:
        """Yield the departure that is left out (BASELINE: none), the seed and the ablation of every training."""
        for name in self.only or (BASELINE, *DEPARTURES[self.task]):
            for seed in self.baseline_seeds if name == BASELINE else self.seeds:
                yield name, seed, DEPARTURES[self.task].get(name, "")

    def command(self, ablation: Ablation, seed: int, folder: Path) -> list[str]:
        """Return the command-line arguments of `jumper train` for an ablation and a seed; folder: root of the logs."""
        flags = f"--num-envs {self.num_envs} --max-iterations {self.length} --seed {seed} --no-tensorboard"
        flags += "" if self.device is None else f" --device {self.device}"
        flags += "" if self.threads is None else f" --threads {self.threads}"
        flags = f"{flags} {JUMP_TASKS[self.task].begin} {self.train_flags} {ablation_flags(ablation)}"
        return [self.task, *shlex.split(flags), "--log-root", str(folder)]


def main(args: Args) -> dict[str, Any]:
    """Train and evaluate each ablation of a jump task, write results as a table and a plot, and return the metrics."""
    for name, seed, ablation in args.trainings():  # refuse wrong flags before the first training
        parse(ablation, args.command(ablation, seed, Path(name)))
    folder, results = prepare("departures", args, args.threads), {}
    values: dict[str, Any] = {"task": args.task, "iterations": args.length, "envs": args.num_envs}
    for name, seed, ablation in tracked([*args.trainings()], "trainings"):
        checkpoint = train_or_load(ablation, args.command(ablation, seed, folder / f"{name}_{seed}"))
        if not args.measure:
            continue
        tests = results[name, seed] = evaluate(checkpoint, args, folder)
        values[f"flags_{name}"] = ablation_flags(ablation)
        values |= {f"{test}_{key}_{name}_{seed}": tests[test][key] for test in TESTS for key in tests[test]}
        write_metrics(folder, values)
        write_table(results, f"{args.task}, {args.length} iterations", folder)
        announce(f"{name}, seed {seed}: {tests['randomized']['success_rate']:.1%} success of randomised robots")
    if not results:
        announce(f"runs in {folder}")
        return values
    keys = [key for key in values if key.startswith("randomized_success_rate_")]
    return report(args, folder, values, f"Departures of {args.task}, {args.length} iterations", keys)


if __name__ == "__main__":
    run_script(main, Args)
