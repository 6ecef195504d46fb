"""The paper's tests of jumps: results of given policies beside the paper's values.

    python experiments/paper_tests.py --out outputs/paper
    python experiments/paper_tests.py --policies vertical_jump logs/horizontal-jump/RUN --randomize

Every policy is evaluated by all suites of its task that have values in the paper (`jumper_warp.evaluation.suites`). The
output folder has a subfolder for each.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import tyro
from rich.console import Console
from rich.table import Table

from jumper_warp.evaluation.run import EvaluationArgs, EvaluationRun, format_value
from jumper_warp.evaluation.suites import suites_for
from jumper_warp.utils.output import output_dir, write_metrics
from support.scripts import run_script


@dataclass(frozen=True)
class Args(EvaluationArgs):
    """Flags."""

    policy: tyro.conf.Suppress[str] = ""
    policies: tuple[str, ...] = ("vertical_jump", "horizontal_jump")
    """Names or folders of policies, runs' folders, or checkpoints."""


def main(args: Args) -> dict:
    """Run all suites, print a table, and return the metrics with a value in the paper, `<policy>_<suite>_<metric>`."""
    folder, values = output_dir("paper_tests", args.out), {}
    table = Table("policy", "test", "metric", "here", "paper")
    for policy in args.policies:
        for name, suite in suites_for(EvaluationRun(policy).task.evaluation_suite).items():
            if not suite.paper:
                continue
            flags: dict[str, Any] = {key: value for key, value in asdict(args).items() if key != "policies"}
            metrics = suite(**flags | {"policy": policy, "out": folder / f"{Path(policy).name}_{name}"}).run()
            for metric, paper in suite.paper.items():
                values[f"{Path(policy).name}_{name}_{metric}"] = metrics[metric]
                table.add_row(policy, name, metric, format_value(metrics[metric]), f"{paper:g}")
    write_metrics(folder, values)
    Console().print(table)
    return values


if __name__ == "__main__":
    run_script(main, Args)
