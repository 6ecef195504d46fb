"""The paper's test of diagonal jumps: goals on a grid 0.35 to 1.4 m ahead and 0.35 m to either side, two jumps each.

    python experiments/diagonal_jump_grid.py --policy horizontal_jump --out outputs/grid

Each jump has a heading of its own, drawn from the full circle. Errors and success are those of
`horizontal_jump_sweep.py`. In range are goals less than 1.4 m ahead, where the paper's jumps all succeed.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import tyro

from jumper_warp.cli.main import run_command
from jumper_warp.evaluation.landings import Landings
from jumper_warp.evaluation.log import termination_names
from jumper_warp.evaluation.places import landing_metrics, random_headings
from jumper_warp.evaluation.plots import draw_landings, drawn
from jumper_warp.evaluation.run import EvaluationArgs, EvaluationRun
from jumper_warp.utils.errors import InputError

AHEAD = (0.35, 1.4)
"""[m]"""
ASIDE = (-0.35, 0.35)
"""[m]"""
PAPER = {"mean_error_m": 0.025, "success_rate": 0.968, "success_rate_in_range": 1.0}
"""The paper's figures for this test, in its simulation."""


@dataclass(frozen=True)
class Args(EvaluationArgs):
    """Flags."""

    jumps: int = 2
    """Number of jumps to each goal."""
    columns: int = 22
    """Number of distances ahead."""
    rows: int = 5
    """Number of distances to the side."""

    def __post_init__(self) -> None:
        """Check the values."""
        super().__post_init__()
        if min(self.jumps, self.columns, self.rows) < 1:
            raise InputError(f"need at least one jump, column and row, got {self.jumps}, {self.columns}, {self.rows}")


def grid(columns: int, rows: int, jumps: int) -> np.ndarray:
    """Return the goals [m], (columns * rows * jumps, 1, 2)."""
    x, y = np.meshgrid(np.linspace(*AHEAD, columns), np.linspace(*ASIDE, rows), indexing="ij")
    return np.repeat(np.stack([x.ravel(), y.ravel()], axis=1), jumps, axis=0)[:, None]


def main(args: Args) -> dict:
    """Run all jumps of the grid and return the figures."""
    run = EvaluationRun.of("diagonal_jump_grid", args)
    goals = grid(args.columns, args.rows, args.jumps)
    env = run.env(len(goals))
    asked = Landings(goals, termination_names(env.task), random_headings(len(goals), args.seed))
    landings = run.follow(env, asked, film="jumps")
    with drawn(run.folder / "grid.png", figsize=(8, 5)) as axis:
        draw_landings(axis, landings, f"{len(goals)} jumps, {run.title}")
    inside = goals[..., 0] < AHEAD[1] - 1.0e-6
    return run.report({"goals": len(goals) // args.jumps, **landing_metrics(landings, inside)}, PAPER)


if __name__ == "__main__":
    run_command(lambda: main(tyro.cli(Args)))
