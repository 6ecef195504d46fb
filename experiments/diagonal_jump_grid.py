"""The paper's test of diagonal jumps: goals on a grid 0.35 to 1.4 m ahead and 0.35 m to either side, two jumps each.

    python experiments/diagonal_jump_grid.py --policy horizontal_jump --out outputs/grid

Each jump has a heading of its own, drawn from the full circle. Errors and success are those of
`horizontal_jump_sweep.py`. In range are goals less than 1.4 m ahead, where the paper's jumps all succeed.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import matplotlib
import numpy as np
import tyro

from jumper_warp.cli.main import run_command
from jumper_warp.evaluation.landings import NEAR, Landings, landing_figures, random_headings
from jumper_warp.evaluation.trial import Trial, TrialArgs

matplotlib.use("Agg")
import matplotlib.pyplot as plt

AHEAD = (0.35, 1.4)
"""[m]"""
ASIDE = (-0.35, 0.35)
"""[m]"""
PAPER = {"mean_error_m": 0.025, "success_rate": 0.968, "success_rate_in_range": 1.0}
"""The paper's figures for this test, in its simulation."""


@dataclass(frozen=True)
class Args(TrialArgs):
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
            raise ValueError(f"need at least one jump, column and row, got {self.jumps}, {self.columns}, {self.rows}")


def grid(columns: int, rows: int, jumps: int) -> np.ndarray:
    """Return the goals [m], (columns * rows * jumps, 1, 2)."""
    x, y = np.meshgrid(np.linspace(*AHEAD, columns), np.linspace(*ASIDE, rows), indexing="ij")
    return np.repeat(np.stack([x.ravel(), y.ravel()], axis=1), jumps, axis=0)[:, None]


def plot(landings: Landings, path: Path, title: str) -> None:
    """Draw goals and landings, seen from above with the start at the origin."""
    goals, landing = landings.goals[:, 0], landings.landing[:, 0]
    fig, axis = plt.subplots(figsize=(8, 5), constrained_layout=True)
    axis.scatter(goals[:, 0], goals[:, 1], s=40, color="tab:red", marker="x", linewidth=1.0, label="goal")
    dots = axis.scatter(
        landing[:, 0], landing[:, 1], s=16, c=landings.error[:, 0], cmap="viridis", vmin=0.0, vmax=NEAR, label="landing"
    )
    failed = ~landings.success[:, 0]
    axis.scatter(landing[failed, 0], landing[failed, 1], s=60, facecolors="none", edgecolors="tab:red", label="failed")
    fig.colorbar(dots, ax=axis, label="distance from the goal [m]")
    axis.set(xlabel="ahead [m]", ylabel="to the left [m]", title=title, aspect="equal")
    axis.legend(loc="upper center", bbox_to_anchor=(0.5, -0.12), ncols=3)
    fig.savefig(path, dpi=110)
    plt.close(fig)


def main(args: Args) -> dict:
    """Run all jumps of the grid and return the figures."""
    trial = Trial("diagonal_jump_grid", args)
    goals = grid(args.columns, args.rows, args.jumps)
    headings = random_headings(len(goals), args.seed)
    landings = trial.jump(trial.env(len(goals)), goals, film="jumps", headings=headings)
    plot(landings, trial.folder / "grid.png", f"{len(goals)} jumps, {trial.title}")
    inside = goals[..., 0] < AHEAD[1] - 1.0e-6
    return trial.report({"goals": len(goals) // args.jumps, **landing_figures(landings, inside)}, PAPER)


if __name__ == "__main__":
    run_command(lambda: main(tyro.cli(Args)))
