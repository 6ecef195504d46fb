"""Measure the shipped policies in all conditions and tests, and write their metrics.json and the tables in docs/.

    python experiments/measure_policies.py --out outputs/policies
    python experiments/measure_policies.py --out outputs/policies --save-to-policies
    python experiments/measure_policies.py --write-tables

The first command evaluates policies as `jumper evaluate` does, once per condition and seed (a row), and runs the
further tests (`support/policy_tests.py`) with the first seed. It writes `OUT/POLICY/CONDITION-SEED/metrics.json` after
each row, and skips existing rows. Work can be interrupted, split by --policies and --conditions, and shared by
processes. The second command saves these rows in the policies' folders. The third one makes the tables in docs/ and the
policies' pages from the saved rows. Only the first one simulates.
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
from jumper_warp.evaluation.evaluations import default_flags
from jumper_warp.evaluation.run import EvaluationRun
from jumper_warp.policies.conditions import Conditions
from jumper_warp.utils.assets import policy_tasks
from jumper_warp.utils.errors import InputError
from jumper_warp.utils.output import read_values
from support.policy_conditions import CONDITIONS, commands_of, payload_overlay, undefined, with_trials
from support.policy_page import pages, write_pages
from support.policy_results import METRICS, read_rows, save_to_policies, tasks_of
from support.policy_tests import COMBINED, TESTS, run_test
from support.scripts import ThreadArgs, run_script

PROGRESS = ("success_rate", "settled_without_collision_rate", "fall_rate")  # Metrics in the lines of progress


@dataclass(frozen=True)
class Args(ThreadArgs):
    """Flags of the measurement of the shipped policies."""

    out: Path = Path("outputs/policies")  # Folder of all rows
    policies: tuple[str, ...] = (*policy_tasks(), COMBINED)
    """Names of the policies; combined: the three policies that walk and jump in turns."""
    conditions: tuple[str, ...] = (*CONDITIONS, *TESTS)  # Names of the conditions and further tests
    seeds: tuple[int, ...] = (0, 1)  # Seeds of sampled commands, robots and noise
    trials: int = 4096  # Least number of trials in a row
    write_tables: tyro.conf.FlagCreatePairsOff[bool] = False
    """Make the tables in docs/ and the policies' pages from the saved rows; nothing is measured."""
    save_to_policies: tyro.conf.FlagCreatePairsOff[bool] = False
    """Write the rows in `out` into metrics.json of the policies' folders; nothing is measured."""

    def __post_init__(self) -> None:
        for names, known in ((self.policies, (*policy_tasks(), COMBINED)), (self.conditions, (*CONDITIONS, *TESTS))):
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
    defined = [
        (policy, condition, seed)
        for policy in args.policies
        for condition in args.conditions
        for seed in (args.seeds[:1] if condition in TESTS else args.seeds)
        if (policy in TESTS[condition].policies if condition in TESTS
            else policy in tasks and undefined(tasks[policy], condition) is None)
    ]  # fmt: skip
    return [row for row in defined if not (args.row(*row) / METRICS).is_file()]


def measure_row(args: Args, policy: str, condition: str, seed: int) -> dict[str, Any]:
    """Evaluate a policy in one condition, write its metrics.json, and return conditions and metrics by name."""
    if condition in TESTS:
        flags = ["--seed", str(seed), *(["--device", args.device] if args.device else [])]
        run_test(policy, condition, args.row(policy, condition, seed), flags)
        return read_values(args.row(policy, condition, seed))
    run, folder, values = EvaluationRun(policy), args.row(policy, condition, seed), dict(CONDITIONS[condition].values)
    if payload := values.pop("payload", None):
        run.settings["payload_kg"], values["robot"] = payload, folder / "payload.json"
        folder.mkdir(parents=True, exist_ok=True)
        payload_overlay(run.recipe.robot, payload).save(values["robot"])
    conditions = Conditions(**values, seed=seed, device=args.device, threads=args.threads)
    flags = with_trials(default_flags(run.evaluation, "evaluate"), args.trials)
    run.settings["commands"] = commands_of(flags)
    with contextlib.redirect_stdout(io.StringIO()):
        return evaluate(run, EvaluateCfg(flags, conditions, folder))


def main(args: Args) -> int:
    """Evaluate policies in missing conditions, or save existing results to the policies, or write tables from them.

    Returns the number of evaluations (rows), or of pages that changed.
    """
    if args.write_tables:
        changed = write_pages(tasks_of(policy_tasks()), pages())
        print("\n".join(map(str, changed)) or "no table changed")
        return len(changed)
    if not args.save_to_policies:
        return measure(args)
    rows = read_rows(args.out, args.policies)
    if not rows:
        raise InputError(f"{args.out} has no rows of these policies")
    save_to_policies(rows, tasks_of(args.policies))
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
    print(f"{len(rows)} rows measured, in {args.out}; --save-to-policies saves them")
    return len(rows)


if __name__ == "__main__":
    run_script(main, Args)
