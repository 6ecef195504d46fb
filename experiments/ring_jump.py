"""Jumps in all directions: goals spread evenly over a ring around the start.

    python experiments/ring_jump.py --policy omnidirectional_jump --radius 0.5 --out outputs/ring

Starts, errors and success are those of `horizontal_jump_sweep.py`; directions are relative to the robot's heading. What
a policy for all directions loses in distance against one that jumps ahead only is seen with `max_jump.py`.
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

SECTORS = ("ahead", "left", "back", "right")
"""Quarters of the ring, each centred on its direction."""


@dataclass(frozen=True)
class Args(TrialArgs):
    """Flags."""

    policy: str = "omnidirectional_jump"
    """Name or folder of a policy, a run's folder, or a checkpoint."""
    jumps: int = 200
    """Number of jumps, one world each."""
    radius: float = 0.5
    """[m] Of the ring."""

    def __post_init__(self) -> None:
        """Check the values."""
        super().__post_init__()
        if self.jumps < len(SECTORS) or not 0.0 < self.radius < 3.0:
            raise ValueError(
                f"need at least {len(SECTORS)} jumps and a radius in (0, 3) m, got {self.jumps}, {self.radius}"
            )


def sectors(goals: np.ndarray) -> np.ndarray:
    """Return the index in SECTORS of each goal (..., 2)."""
    angle = np.arctan2(goals[..., 1], goals[..., 0])
    return np.round(angle / (0.5 * np.pi)).astype(int) % len(SECTORS)


def figures(landings: Landings) -> dict:
    """Return the figures of the ring, with the success of each quarter."""
    values = landing_figures(landings)
    sector = sectors(landings.goals)
    for index, name in enumerate(SECTORS):
        values[f"success_rate_{name}"] = float(landings.success[sector == index].mean())
    return values


def plot(landings: Landings, path: Path, title: str) -> None:
    """Draw goals and landings in the frame of the start, x ahead."""
    goals, landing, good = landings.goals[:, 0], landings.landing[:, 0], landings.success[:, 0]
    fig, axis = plt.subplots(figsize=(6, 6), constrained_layout=True)
    axis.scatter(goals[:, 0], goals[:, 1], s=22, color="0.4", marker="x", linewidth=0.8, label="goal")
    axis.scatter(landing[good, 0], landing[good, 1], s=9, color="tab:blue", label=f"landed within {NEAR:g} m")
    axis.scatter(landing[~good, 0], landing[~good, 1], s=14, color="tab:red", label="failed")
    axis.set(xlabel="ahead [m]", ylabel="to the left [m]", title=title, aspect="equal")
    axis.legend(loc="center")
    fig.savefig(path, dpi=110)
    plt.close(fig)


def main(args: Args) -> dict:
    """Jump to the ring and return the figures."""
    trial = Trial("ring_jump", args)
    angle = np.linspace(0.0, 2.0 * np.pi, args.jumps, endpoint=False)
    goals = args.radius * np.stack([np.cos(angle), np.sin(angle)], axis=-1)[:, None]
    landings = trial.jump(trial.env(args.jumps), goals, film="jumps", headings=random_headings(args.jumps, args.seed))
    plot(landings, trial.folder / "landings.png", f"{args.jumps} jumps over {args.radius:g} m, {trial.title}")
    return trial.report(figures(landings), {})


if __name__ == "__main__":
    run_command(lambda: main(tyro.cli(Args)))
