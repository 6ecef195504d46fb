"""Measure how well the shipped policies do under all test conditions, and write metrics and docs/results.md.

    python experiments/measure_policies.py --out outputs/policies
    python experiments/measure_policies.py --out outputs/policies --write-tables docs --save-to-policies

The first command evaluates policies as `jumper evaluate` does, once per condition and seed (a row). It writes
`OUT/POLICY/CONDITION-SEED/metrics.json` after each row, and skips existing rows. Work can be interrupted, split by
--policies and --conditions, and shared by processes. The second command reads these files and simulates nothing.
"""

from __future__ import annotations

import contextlib
import gc
import io
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
import tyro

from jumper_warp.evaluation.commands import EvaluateCfg, evaluate
from jumper_warp.evaluation.run import EvaluationRun
from jumper_warp.policies.conditions import Conditions
from jumper_warp.utils.assets import policy_tasks
from jumper_warp.utils.errors import InputError
from support.policy_conditions import CONDITIONS, commands_of, payload_overlay, undefined, with_trials
from support.policy_page import write_page
from support.policy_results import METRICS, read_rows, save_to_policies, tasks_of
from support.scripts import ThreadArgs, run_script

PROGRESS = ("success_rate", "settled_without_collision_rate", "fall_rate")  # Metrics in the lines of progress


@dataclass(frozen=True)
class Args(ThreadArgs):
    """Flags of the measurement of the shipped policies."""

    out: Path = Path("outputs/policies")  # Folder of all rows
    policies: tuple[str, ...] = tuple(policy_tasks())  # Names of the policies
    conditions: tuple[str, ...] = tuple(CONDITIONS)  # Names of the conditions
    seeds: tuple[int, ...] = (0, 1)  # Seeds of sampled commands, robots and noise
    trials: int = 4096  # Least number of trials in a row
    write_tables: Path | None = None  # Folder for results.md, from the rows in `out`; nothing is measured
    save_to_policies: tyro.conf.FlagCreatePairsOff[bool] = False
    """Write the rows in `out` into metrics.json of the policies' folders; nothing is measured."""

    def __post_init__(self) -> None:
        for names, known in ((self.policies, tuple(policy_tasks())), (self.conditions, tuple(CONDITIONS))):
            if unknown := sorted(set(names) - set(known)):
                raise InputError(f"no {unknown[0]!r:.40}; there are {', '.join(known)}")
        if not self.seeds or self.trials < 16:
            raise InputError(f"need a seed and at least 16 trials, got {self.seeds} and {self.trials}")

    def row(self, policy: str, condition: str, seed: int) -> Path:
        """Return the folder with the results of a policy in one condition with one seed (a row)."""
        return self.out / policy / f"{condition}-{seed}"


def missing_rows(args: Args) -> list[tuple[str, str, int]]:
    """Return the evaluations that are still to be done: policy, condition and seed.

    These have no metrics.json, and the condition is defined for the policy.
    """
    tasks = tasks_of(args.policies)
    return [
        (policy, condition, seed)
        for policy in args.policies
        for condition in args.conditions
        if undefined(tasks[policy], condition) is None
        for seed in args.seeds
        if not (args.row(policy, condition, seed) / METRICS).is_file()
    ]


def measure_row(args: Args, policy: str, condition: str, seed: int) -> dict[str, Any]:
    """Evaluate a policy in one condition, write its metrics.json, and return conditions and metrics by name."""
    run, folder, values = EvaluationRun(policy), args.row(policy, condition, seed), dict(CONDITIONS[condition].values)
    if payload := values.pop("payload", None):
        run.settings["payload_kg"], values["robot"] = payload, folder / "payload.json"
        folder.mkdir(parents=True, exist_ok=True)
        payload_overlay(Conditions().overlay(run.policy.config), payload).save(values["robot"])
    conditions = Conditions(**values, seed=seed, device=args.device, threads=args.threads)
    flags = with_trials(run.evaluation.flags, args.trials)
    run.settings["commands"] = commands_of(flags)
    with contextlib.redirect_stdout(io.StringIO()):
        return evaluate(run, EvaluateCfg(flags, conditions, folder))


def main(args: Args) -> int:
    """Evaluate policies in missing conditions, or write tables and policies' files from existing results.

    Returns the number of evaluations (rows).
    """
    if args.write_tables is None and not args.save_to_policies:
        return measure(args)
    rows, tasks = read_rows(args.out, args.policies), tasks_of(args.policies)
    if not rows:
        raise InputError(f"{args.out} has no rows of these policies")
    if args.write_tables is not None:
        print(write_page(args.write_tables, rows, tasks))
    if args.save_to_policies:
        save_to_policies(rows, tasks)
    return len(rows)


def measure(args: Args) -> int:
    """Evaluate policies in all missing conditions, print the progress, and return the number of evaluations."""
    rows, started = missing_rows(args), time.perf_counter()
    for number, row in enumerate(rows, 1):
        values = measure_row(args, *row)
        gc.collect()  # frees the device memory of the environment
        if torch.cuda.is_available():
            torch.cuda.empty_cache()
        spent = time.perf_counter() - started
        rates = ", ".join(f"{key} {values[key]:.4g}" for key in PROGRESS if key in values)
        times = f"{spent / 60:.1f} min, {spent / number * (len(rows) - number) / 60:.1f} min left"
        print(f"{number}/{len(rows)} {' '.join(map(str, row))}: {rates}; {times}", flush=True)
    print(f"{len(rows)} rows measured, in {args.out}; --write-tables FOLDER writes their tables")
    return len(rows)


if __name__ == "__main__":
    run_script(main, Args)
