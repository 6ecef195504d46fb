"""What departures of a jump from the paper and its authors' configuration change: trained without each, one at a time.

    python experiments/departures.py --task vertical-jump --out outputs/departures
    python experiments/departures.py --task horizontal-jump --only bracing goals --seeds 1 2

Trainings are alike but for what is undone (`support.departures`): from nothing (on Mars from the policy of Earth),
randomised, equally long. The task with all departures, `kept`, is trained with every seed of `--baseline-seeds`; these
runs show the spread between seeds. Each policy then makes nominal and randomised jumps as `jumper evaluate` has them, a
fall or a touch after the landing being a failure, and robots of each kind wait in their squats for 3 s. The task's own
terminations end a jump, whatever the training had. A training that `--out` holds already is not repeated, so that an
interrupted run continues, and `--no-measure` may train on one machine while another measures.
"""

from __future__ import annotations

import shlex
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rich.console import Console

from jumper_warp.cli.main import run_command
from jumper_warp.utils.errors import InputError
from jumper_warp.utils.output import write_metrics
from support.departure_runs import JUMPS, KEPT, TESTS, WIDTH, Jump, measured, report, settings, trained
from support.departures import DEPARTURES, Undone, flags_of
from support.scripts import ThreadArgs, parse_flags, prepare


@dataclass(frozen=True)
class Args(ThreadArgs):
    """Flags."""

    task: Jump = "vertical-jump"
    """Task whose departures are undone."""
    only: tuple[str, ...] = ()
    """Names of the departures to undo (default: all)."""
    iterations: int | None = None
    """Iterations of each training (default: 800 or 1000, when the task with all departures has learned)."""
    num_envs: int = 8192
    """Number of environments."""
    seeds: tuple[int, ...] = (1,)
    """Seeds of the trainings without one departure."""
    baseline_seeds: tuple[int, ...] = (1, 2, 3)
    """Seeds of the trainings with all departures."""
    num_jumps: tuple[int, int] = (200, 1000)
    """Numbers of nominal and of randomised jumps."""
    num_squats: int = 100
    """Number of robots that hold a squat."""
    train_flags: str = ""
    """More flags of `jumper train`, for all trainings: --train-flags="--ppo.gamma 0.98"."""
    measure: bool = True
    """Make the jumps after each training."""

    def __post_init__(self) -> None:
        unknown = set(self.only) - {KEPT, *DEPARTURES[self.task]}
        if unknown:
            raise InputError(f"departures of {self.task} are {', '.join(DEPARTURES[self.task])}, not {min(unknown)}")
        if self.length < 1 or self.num_envs < 1 or min(self.num_jumps) < 1 or self.num_squats < 1:
            raise InputError("iterations, num_envs, num_jumps and num_squats must be at least 1")

    @property
    def length(self) -> int:
        """Iterations of each training."""
        return JUMPS[self.task].iterations if self.iterations is None else self.iterations

    def trainings(self) -> Iterator[tuple[str, int, Undone]]:
        """Yield name, seed, and what undoes the departure."""
        for name in self.only or (KEPT, *DEPARTURES[self.task]):
            for seed in self.baseline_seeds if name == KEPT else self.seeds:
                yield name, seed, DEPARTURES[self.task].get(name, "")

    def command(self, undone: Undone, seed: int, folder: Path) -> list[str]:
        """Return the arguments of `jumper train`."""
        flags = f"--num-envs {self.num_envs} --max-iterations {self.length} --seed {seed} --no-tensorboard"
        flags += "" if self.device is None else f" --device {self.device}"
        flags += "" if self.threads is None else f" --threads {self.threads}"
        flags = f"{flags} {JUMPS[self.task].begin} {self.train_flags} {flags_of(undone)}"
        return [self.task, *shlex.split(flags), "--log-root", str(folder)]


def main(args: Args) -> dict[str, Any]:
    """Train and measure each, and return the metrics."""
    for name, seed, undone in args.trainings():  # a wrong flag is refused before any training
        settings(undone, args.command(undone, seed, Path(name)))
    folder, found, table = prepare("departures", args, args.threads), {}, None
    values: dict[str, Any] = {"task": args.task, "iterations": args.length, "envs": args.num_envs}
    for name, seed, undone in args.trainings():
        checkpoint = trained(undone, args.command(undone, seed, folder / f"{name}_{seed}"))
        if not args.measure:
            continue
        tests = found[name, seed] = measured(checkpoint, args, folder)
        values[f"flags_{name}"] = flags_of(undone)
        values |= {f"{test}_{key}_{name}_{seed}": tests[test][key] for test in TESTS for key in tests[test]}
        write_metrics(folder, values)
        table = report(found, f"{args.task}, {args.length} iterations", folder)
    if table is not None:
        Console(width=WIDTH).print(table)
    print(f"{'metrics, table, plot and ' if found else ''}runs in {folder}")
    return values


if __name__ == "__main__":
    run_command(lambda: main(parse_flags(Args)))
