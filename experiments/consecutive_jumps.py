"""The paper's test of jumps in a row, and a longer one: the next jump is commanded a second after touchdown.

    python experiments/consecutive_jumps.py --policy horizontal_jump --out outputs/consecutive

The paper's pairs are (0.8, 0.2) m then (0.75, -0.2) m, and 0.8 m then 0.8 m straight ahead. Ten in a row go to goals
drawn within 0.4 to 0.9 m ahead and 0.2 m to either side. A goal is relative to where the robot stands and looks when
the jump is commanded. Robots differ in heading and in how long they wait for the first command.

The error of a jump is the distance of the base from its goal when the next one is commanded; after a fall or a
collision no further jump counts. `ten_in_a_row_rate` is the share of rows in which none of the jumps ended so, wherever
they landed; `row_all_on_goal_rate` that of rows in which every jump succeeded as in `horizontal_jump_sweep.py`. At its
end, `rest_s` after touchdown, a landed base should be at rest. The range of `success_rate_in_range` is all goals.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import tyro

from jumper_warp.cli.main import run_command
from jumper_warp.evaluation.jumps import REST_TIME
from jumper_warp.evaluation.landings import Landings
from jumper_warp.evaluation.log import mean, termination_names
from jumper_warp.evaluation.places import AT_END, landing_metrics, random_headings
from jumper_warp.evaluation.plots import Track, draw_paths
from jumper_warp.evaluation.run import EvaluationArgs, EvaluationRun
from jumper_warp.utils.errors import InputError

PAIRS = {"diagonal": ((0.8, 0.2), (0.75, -0.2)), "straight": ((0.8, 0.0), (0.8, 0.0))}
"""[m]"""
ROW_LOWER, ROW_UPPER = (0.4, -0.2), (0.9, 0.2)
"""[m] Goals of the jumps in a long row."""
DELAY = (0.3, 1.0)
"""[s] Until the first command."""
OF_TEN = (
    "success_rate", "fall_rate", "miss_rate", "step_rate", "still_landing_rate", "second_takeoff_rate",
    "max_landing_tilt_deg",
)  # fmt: skip
"""Figures that are told of the long rows too."""
PAPER = {"mean_error_m": 0.0054}
"""The paper's figure for the pairs, on the robot."""


@dataclass(frozen=True)
class Args(EvaluationArgs):
    """Flags."""

    jumps: int = 20
    """Number of times that each pair is jumped."""
    trials: int = 100
    """Number of long rows."""
    row: int = 10
    """Number of jumps in one."""
    rest: float = REST_TIME
    """[s] From touchdown to the next command."""

    def __post_init__(self) -> None:
        """Check the values."""
        super().__post_init__()
        if min(self.jumps, self.trials, self.row) < 1:
            raise InputError(f"need at least one jump, trial and row, got {self.jumps}, {self.trials}, {self.row}")
        if not 0.1 <= self.rest <= 10.0:
            raise InputError(f"rest must be in [0.1, 10] s, got {self.rest}")


def metrics(pairs: Landings, row: Landings) -> dict:
    """Return the metrics of both tests; the first half of the pairs are the diagonal ones."""
    values, ten = (landing_metrics(landings) for landings in (pairs, row))
    for part in (values, ten):
        if "at_rest_within_1_s_rate" in part:
            part[AT_END] = part.pop("at_rest_within_1_s_rate")
    values["success_rate_in_range"] = values["success_rate"]
    half = len(pairs.goals) // 2
    for name, part in zip(PAIRS, (slice(None, half), slice(half, None)), strict=True):
        values[f"mean_error_{name}_m"] = mean(pairs.error[part])
    values |= {f"mean_error_jump_{i + 1}_m": mean(pairs.error[:, i]) for i in range(2)}
    values["both_landed_rate"] = float(pairs.landed.all(axis=1).mean())
    return values | {
        "row": row.goals.shape[1],
        "trials": len(row.goals),
        "ten_in_a_row_rate": float(row.landed.all(axis=1).mean()),
        "row_all_on_goal_rate": float(row.success.all(axis=1).mean()),
        "mean_jumps_until_the_end": float(row.landed.sum(axis=1).mean()),
        "mean_error_ten_m": ten["mean_error_m"],
        **{f"{name}_ten": ten[name] for name in OF_TEN},
        f"{AT_END}_ten": ten[AT_END],
        "mean_error_by_number_m": [mean(row.error[:, i]) for i in range(row.goals.shape[1])],
    }


def main(args: Args) -> dict:
    """Run both tests and return the figures."""
    run = EvaluationRun.of("consecutive_jumps", args)
    rng = np.random.default_rng(args.seed)
    pairs = np.repeat(np.array(list(PAIRS.values())), args.jumps, axis=0)
    rows = rng.uniform(ROW_LOWER, ROW_UPPER, (args.trials, args.row, 2))
    done, paths = [], []
    for name, goals in (("pairs", pairs), ("row", rows)):
        headings, track = random_headings(len(goals), args.seed), Track()
        delay = rng.uniform(*DELAY, len(goals))
        env = run.env(len(goals))
        asked = Landings(goals, termination_names(env.task), headings, delay=delay, rest=args.rest)
        done.append(run.follow(env, asked, film=name, watch=track))
        paths.append(track.in_start_frame(headings))
    names = (*PAIRS, f"{args.row} in a row")
    parts = dict(zip(names, (*np.split(paths[0], 2), paths[1]), strict=True))
    draw_paths(run.folder / "paths.png", parts, PAIRS, run.title)
    return run.report({"rest_s": args.rest, **metrics(*done)}, PAPER)


if __name__ == "__main__":
    run_command(lambda: main(tyro.cli(Args)))
