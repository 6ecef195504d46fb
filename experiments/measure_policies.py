"""Measures the shipped policies under all test conditions, and writes the tables of docs/results.md.

    python experiments/measure_policies.py --out outputs/policies
    python experiments/measure_policies.py --out outputs/policies --write-tables docs --save-to-policies

The first command evaluates policies as `jumper evaluate` does, once per condition and seed (a row). It writes
`OUT/POLICY/CONDITION-SEED/metrics.json` after each row, and skips rows that exist: work can be interrupted, split by
--policies and --conditions, and shared by processes. The second command reads these files; it simulates nothing.
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

from jumper_warp.evaluation.commands import EvaluateCfg, evaluate
from jumper_warp.evaluation.run import EvaluationRun
from jumper_warp.policies.conditions import Conditions
from jumper_warp.policies.folder import list_policies
from jumper_warp.utils.errors import InputError
from support.policy_conditions import CONDITIONS, commands_of, payload_overlay, undefined, with_trials
from support.scripts import ThreadArgs, run_script

METRICS = "metrics.json"  # Name of a row's file
PROGRESS = ("success_rate", "settled_without_collision_rate", "fall_rate")  # Metrics in the lines of progress


@dataclass(frozen=True)
class Args(ThreadArgs):
    """Flags."""

    out: Path = Path("outputs/policies")  # Folder of all rows
    policies: tuple[str, ...] = list_policies()  # Names of the policies
    conditions: tuple[str, ...] = tuple(CONDITIONS)  # Names of the conditions
    seeds: tuple[int, ...] = (0, 1)  # Seeds of sampled commands, robots and noise
    trials: int = 4096  # Least number of trials in a row

    def __post_init__(self) -> None:
        for kind, names, known in (
            ("policy", self.policies, list_policies()),
            ("condition", self.conditions, tuple(CONDITIONS)),
        ):
            if unknown := sorted(set(names) - set(known)):
                raise InputError(f"no {kind} {unknown[0]!r:.40}; there are {', '.join(known)}")
        if not self.seeds or self.trials < 16:
            raise InputError(f"need a seed and at least 16 trials, got {self.seeds} and {self.trials}")


def row_folder(args: Args, policy: str, condition: str, seed: int) -> Path:
    """Return the folder of a row's metrics.json."""
    return args.out / policy / f"{condition}-{seed}"


def missing_rows(args: Args) -> list[tuple[str, str, int]]:
    """Return policy, condition and seed of the rows without a metrics.json, where the condition is defined."""
    tasks = {policy: EvaluationRun(policy).task for policy in args.policies}
    return [
        (policy, condition, seed)
        for policy in args.policies
        for condition in args.conditions
        if undefined(tasks[policy], condition) is None
        for seed in args.seeds
        if not (row_folder(args, policy, condition, seed) / METRICS).is_file()
    ]


def measure_row(args: Args, policy: str, condition: str, seed: int) -> dict[str, Any]:
    """Evaluate a policy in a condition, write the row's metrics.json, and return the metrics by key."""
    run, folder = EvaluationRun(policy), row_folder(args, policy, condition, seed)
    values = dict(CONDITIONS[condition].values)
    if payload := values.pop("payload", None):
        run.settings["payload_kg"], values["robot"] = payload, folder / "payload.json"
        folder.mkdir(parents=True, exist_ok=True)
        payload_overlay(Conditions().overlay(run.policy.config), payload).save(values["robot"])
    conditions = Conditions(**values, seed=seed, device=args.device, threads=args.threads)
    flags = with_trials(run.evaluation.flags, args.trials)
    run.settings["commands"] = commands_of(flags)
    with contextlib.redirect_stdout(io.StringIO()):
        return evaluate(run, EvaluateCfg(flags, conditions, folder))


def free_memory() -> None:
    """Return the device memory of past environments, so that the next one finds it free."""
    gc.collect()
    if torch.cuda.is_available():
        torch.cuda.empty_cache()


def main(args: Args) -> int:
    """Measure the missing rows, and return their number."""
    rows, started = missing_rows(args), time.perf_counter()
    print(f"{len(rows)} rows to measure", flush=True)
    for number, row in enumerate(rows, 1):
        before = time.perf_counter()
        values = measure_row(args, *row)
        free_memory()
        spent = time.perf_counter() - started
        rates = ", ".join(f"{key} {values[key]:.4g}" for key in PROGRESS if key in values)
        left = spent / number * (len(rows) - number)
        print(f"{number}/{len(rows)} {' '.join(map(str, row))}: {rates}; "
              f"{time.perf_counter() - before:.0f} s, {left / 60:.1f} min left", flush=True)  # fmt: skip
    return len(rows)


if __name__ == "__main__":
    run_script(main, Args)
