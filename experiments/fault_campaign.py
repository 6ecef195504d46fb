"""Kill or disturb trainings at random moments, resume them, and compare each with an undisturbed one, bit by bit.

    python experiments/fault_campaign.py --out outputs/faults
    python experiments/fault_campaign.py --out outputs/faults --trials 240

A trial trains a small policy on the CPU, with faults at random file operations or processor times, and then resumes the
run to its end. The last checkpoint and all metrics must be those of an undisturbed training with the same seed. Faults
are a function of `--seed` and the number of the trial. Started again with the same folder, the campaign continues after
its last trial. `faults.json` and `faults.md` list what was tried, how often, and how many iterations were repeated. The
full disk is a small tmpfs, which needs root on Linux.
"""

from __future__ import annotations

import json
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from jumper_warp.utils.checks import check_seed
from jumper_warp.utils.errors import InputError
from jumper_warp.utils.files import write_atomically
from jumper_warp.utils.locks import write_lock
from jumper_warp.utils.output import output_dir
from support.fault_trials import TRIALS, run_trial
from support.faults import warm_up
from support.scripts import OutputArgs, announce, report, run_script

LOG = "trials.jsonl"  # File in the output folder with one JSON object per trial
SUMMARY = ("kills", "trials", "trials_unequal_or_unexpected", "iterations_repeated_max")  # Keys of metrics
HEADER = "| fault | times | iterations repeated, most | trials | unequal or unexpected |\n|---|---|---|---|---|\n"


@dataclass(frozen=True)
class Args(OutputArgs):
    """Flags of the test of training under injected faults."""

    trials: int = 60  # Number of trials, over all starts with the same --out
    max_seconds: float = 480.0  # [s] Time after which no further trial starts; one takes some 5 s on two free cores
    seed: int = 0  # Seed of the faults
    faults: tuple[str, ...] = ("kills", "full_disk", "kills", "read_only", "kills", "deleted", "kills", "writers",
        "kills", "killed_rank", "kills", "clock")  # fmt: skip
    """Faults of the trials, in turn."""

    def __post_init__(self) -> None:
        check_seed(self.seed)
        if unknown := [name for name in self.faults if name not in TRIALS]:
            raise InputError(f"faults are {', '.join(TRIALS)}, got {unknown[0]!r:.60}")


def read_trials(folder: Path, seed: int) -> list[dict[str, Any]]:
    """Return the results of all trials in a campaign's folder. Raises InputError: they have another seed."""
    path = folder / LOG
    trials = [json.loads(line) for line in path.read_text().splitlines()] if path.is_file() else []
    if any(trial["seed"] != seed for trial in trials):
        raise InputError(f"{path}: was made with --seed {trials[0]['seed']}, got {seed}")
    return trials


def fault_rows(trials: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Return a dict for each fault: its count, the most iterations lost to it, and numbers of trials and failures."""
    faults = sorted({fault for trial in trials for fault, _ in trial["faults"]})
    rows = []
    for fault in faults:
        of_fault = [trial for trial in trials if any(fault == name for name, _ in trial["faults"])]
        lost = [lost for trial in of_fault for name, lost in trial["faults"] if name == fault]
        failed = sum(bool(trial["unexpected"]) for trial in of_fault)
        rows.append({"fault": fault, "times": len(lost), "lost": max(lost), "trials": len(of_fault), "failed": failed})
    return rows


def write_tables(folder: Path, trials: list[dict[str, Any]]) -> dict[str, Any]:
    """Write `faults.json` and `faults.md`, and return metrics of all trials."""
    rows = fault_rows(trials)
    failed = [f"trial {trial['trial']}: {trial['unexpected']}" for trial in trials if trial["unexpected"]]
    write_atomically(folder / "faults.json", json.dumps({"faults": rows, "unexpected": failed}, indent=1).encode())
    lines = "".join(f"| {' | '.join(map(str, row.values()))} |\n" for row in rows)
    write_atomically(folder / "faults.md", (HEADER + lines + "".join(f"\n- {line}" for line in failed)).encode())
    return {
        "trials": len(trials), "kills": sum(row["times"] for row in rows if row["fault"].startswith("SIG")),
        "trials_unequal_or_unexpected": len(failed),
        "iterations_repeated_max": max((row["lost"] for row in rows if row["fault"].startswith("SIG")), default=0),
    }  # fmt: skip


def main(args: Args) -> dict[str, Any]:
    """Run trials that the output folder lacks, until the time limit, and return metrics of all trials in the folder."""
    start, folder = time.monotonic(), output_dir("fault_campaign", args.out).absolute()
    with write_lock(folder):
        trials = read_trials(folder, args.seed)
        warm_up()
        for number in range(len(trials), args.trials):
            if time.monotonic() - start > args.max_seconds:
                break
            trials.append(run_trial(args.faults[number % len(args.faults)], args.seed, number, folder))
            with (folder / LOG).open("a") as log:
                log.write(json.dumps(trials[-1]) + "\n")
            announce(f"trial {number}: {json.dumps(trials[-1]['faults'])} {trials[-1]['unexpected']}".rstrip())
            write_tables(folder, trials)
        metrics = write_tables(folder, trials) | {"seed": args.seed}
    return report(args, folder, metrics, f"{len(trials)} trainings with faults", SUMMARY)


if __name__ == "__main__":
    run_script(main, Args)
