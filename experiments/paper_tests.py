"""Run the paper's tests of jumps, print the results beside the paper's values, and write metrics, plots and recordings.

    python experiments/paper_tests.py --out outputs/paper
    python experiments/paper_tests.py --policies vertical_jump logs/horizontal-jump/RUN --randomize

Every policy is evaluated by all suites of its task that have values in the paper (`jumper evaluate --suite`). Each has
a folder in the output folder.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path

import tyro

from jumper_warp.evaluation.run import EvaluationArgs, EvaluationRun
from jumper_warp.evaluation.suites import suites_for
from jumper_warp.utils.files import Json
from jumper_warp.utils.metrics import Metrics
from jumper_warp.utils.output import output_dir, read_values
from support.scripts import report, run_script


@dataclass(frozen=True)
class Args(EvaluationArgs):
    """Flags of the paper's tests of jumps."""

    policy: tyro.conf.Suppress[str] = ""
    policies: tuple[str, ...] = ("vertical_jump", "horizontal_jump")
    """Names or folders of policies, runs' folders, or checkpoints."""


def main(args: Args) -> dict:
    """Run the paper's tests of each policy, print and return those metrics for which the paper states a value.

    Keys: `<policy>_<suite>_<key>`.
    """
    folder = output_dir("paper_tests", args.out)
    paper = {}
    metrics: Metrics = {}
    for policy in args.policies:
        for name, suite in suites_for(EvaluationRun(policy).task).items():
            if not suite.paper:
                continue
            flags: Json = {key: value for key, value in asdict(args).items() if key != "policies"}
            prefix = f"{Path(policy).name}_{name}"
            run, values = suite(**flags | {"policy": policy, "out": folder / prefix}).evaluate()
            run.write(values)
            metrics |= {f"{prefix}_{key}": values[key] for key in suite.paper}
            paper |= {f"{prefix}_{key}": value for key, value in suite.paper.items()}
    report(args, folder, metrics, f"The paper's tests of {', '.join(args.policies)}", metrics, paper)
    return read_values(folder)


if __name__ == "__main__":
    run_script(main, Args)
