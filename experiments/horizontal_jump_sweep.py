"""The paper's test of the horizontal jump: a policy jumps 0.3 to 1.5 m straight ahead, spread evenly, each once.

    python experiments/horizontal_jump_sweep.py --policy horizontal_jump --jumps 200 --out outputs/sweep

Every robot stands in the default pose, with a heading of its own drawn from the full circle, and is told to jump after
half a second. The error is the distance of the base from its goal in the plane a second after touchdown, or where the
jump failed before. A jump succeeds if it was begun on command, ends within 0.1 m of its goal, and nothing but the paws
touched anything; a landing may go on with steps or a second hop, which are told apart. `--randomize` adds the
randomisation, noise and latency of the training; `--solver mujoco` is a check against physics that the policy was not
trained on.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import matplotlib
import numpy as np
import tyro

from jumper_warp.cli.main import run_command
from jumper_warp.evaluation.jumps import within
from jumper_warp.evaluation.landings import NEAR, Landings, landing_figures, random_headings, trained_range
from jumper_warp.evaluation.trial import Trial, TrialArgs

matplotlib.use("Agg")
import matplotlib.pyplot as plt

LOWER, UPPER = 0.3, 1.5
"""[m] Distances of the goals."""
IN_RANGE = (0.3, 1.4)
"""[m] Those that the paper reaches always."""
TRAINED = (0.4, 1.0)
"""[m] Those of the paper's training."""
PAPER = {"mean_error_m": 0.026, "success_rate": 0.97, "success_rate_in_range": 1.0}
"""The paper's figures for this test, in its simulation."""


@dataclass(frozen=True)
class Args(TrialArgs):
    """Flags."""

    jumps: int = 200
    """Number of jumps, one world each."""
    record: int = 5
    """Number of jumps to record for the Rerun viewer and, one of them, as a filmstrip; 0: none."""

    def __post_init__(self) -> None:
        """Check the values."""
        super().__post_init__()
        if self.jumps < 3:
            raise ValueError(f"need at least 3 jumps, got {self.jumps}")


def figures(landings: Landings) -> dict:
    """Return the figures of the sweep."""
    distance = landings.goals[..., 0]
    values = landing_figures(landings, within(distance, IN_RANGE))
    values["success_rate_0_4_1_0"] = float(landings.success[within(distance, TRAINED)].mean())
    return values


def plot(landings: Landings, trained: tuple[float, float], path: Path, title: str) -> None:
    """Draw reached over commanded distance; trained [m]: distances of the policy's training."""
    line = np.array([LOWER, UPPER])
    target, reached = landings.goals[:, 0, 0], landings.landing[:, 0, 0]
    good = landings.success[:, 0]
    fig, axis = plt.subplots(figsize=(6, 5.5), constrained_layout=True)
    axis.fill_between(line, line - NEAR, line + NEAR, color="tab:green", alpha=0.12, label=f"within {NEAR:g} m")
    axis.plot(line, line, color="tab:green", linewidth=1.0, label="commanded")
    axis.axvspan(*TRAINED, color="0.5", alpha=0.08, label="training of the paper")
    axis.axvspan(
        *trained, color="tab:orange", alpha=0.06, label=f"training of this policy, {trained[0]:g}-{trained[1]:g} m"
    )
    axis.scatter(target[good], reached[good], s=9, color="tab:blue", label="landed there")
    axis.scatter(target[~good], reached[~good], s=14, color="tab:red", marker="x", label="failed")
    axis.set(xlabel="commanded distance [m]", ylabel="distance of the base at the end [m]", title=title)
    axis.set_xlim(LOWER - 0.05, UPPER + 0.05)
    axis.legend(loc="upper left")
    fig.savefig(path, dpi=110)
    plt.close(fig)


def main(args: Args) -> dict:
    """Run the sweep and return its figures."""
    trial = Trial("horizontal_jump_sweep", args)
    goals = np.zeros((args.jumps, 1, 2))
    goals[:, 0, 0] = np.linspace(LOWER, UPPER, args.jumps)
    headings = random_headings(args.jumps, args.seed)
    env = trial.env(args.jumps)
    landings = trial.jump(env, goals, film="jumps", headings=headings)
    trained = trained_range(env.task)
    limits = (trained["trained_lower_m"], trained["trained_upper_m"])
    plot(landings, limits, trial.folder / "sweep.png", f"{args.jumps} jumps, {trial.title}")
    return trial.report(figures(landings) | trained, PAPER)


if __name__ == "__main__":
    run_command(lambda: main(tyro.cli(Args)))
