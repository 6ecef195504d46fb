"""Page results.md with the measured results of the shipped policies."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

from jumper_warp.tasks.cfg import TaskCfg
from jumper_warp.utils.files import write_atomically
from support.policy_comparisons import old_section, seed_section
from support.policy_results import Row, policy_section

PAGE = """\
# Results of the shipped policies

This page lists every policy of `assets/policies` under all test conditions; `experiments/measure_policies.py` writes
it. The tables show the first seed. `metrics.json` in a policy's folder has all metrics of two seeds, with intervals.

- **Success**: the robot jumps on command, reaches its goal within 0.1 m, lands without a fall, and its base is slower
  than 0.1 m/s a second after touchdown. The goal is a height of the base at the apex, or a place of the base at rest.
- **Reached, landed, still**: parts of a jump by themselves. Still: no paw is lifted again for 0.05 s or longer.
- **Errors of places** are horizontal distances from goal to base, at touchdown and a second later. Before far goals the
  base touches down short of its goal, and moves the rest over planted paws. Flown: from takeoff to touchdown.
- **RMSE of walks**: over all time until a fall; settled: without the first second after each command; slewed: of
  commands that change by 1.25 m/s² and rad/s². Drift: distance from the start after 9 s of zero command.
- **Turns** of a floating robot have settled if the error stays within 5° from some time to the end.
- **Solvers**: SolverJumper, used in training, has plastic contact. The contact of SolverMuJoCo is compliant.
- **Randomised robots** have sampled masses, motors, friction, sensor errors and latency. They are pushed while a paw is
  on the ground, and their observations have noise. Ranges are those of the training.

Parentheses hold 95 % intervals (Wilson). Rows of the paper have the paper's definitions, and few trials.

    python experiments/measure_policies.py --out outputs/policies
    python experiments/measure_policies.py --out outputs/policies --write-tables docs

"""
SEEDS = """\
## Two seeds

Seeds sample goals, headings, robots, noise and pushes. Conditions that sample nothing give the same values twice.

"""
OLD = """\
## Old and new definitions

A cell has the value under the old definition, as shipped earlier, and the present one. Letters give the reasons for an
old value outside the present 95 % interval. D: other definition; C: other commands; S: other sample of robots or goals.

"""


def write_page(folder: Path, rows: Sequence[Row], tasks: Mapping[str, TaskCfg]) -> Path:
    """Write the page results.md with all policies' results into a folder, and return its path.

    rows: as `read_rows` returns them; tasks: by policy.
    """
    first = [row for row in rows if row.seed == min(each.seed for each in rows if each[:2] == row[:2])]
    own = {policy: [row for row in first if row.policy == policy] for policy in tasks}
    sections = [policy_section(policy, tasks[policy], measured) for policy, measured in own.items() if measured]
    folder.mkdir(parents=True, exist_ok=True)
    text = PAGE + "\n".join(sections) + "\n" + SEEDS + seed_section(rows) + "\n" + OLD + old_section(first, tasks)
    write_atomically(folder / "results.md", (text.rstrip("\n") + "\n").encode())
    return folder / "results.md"
