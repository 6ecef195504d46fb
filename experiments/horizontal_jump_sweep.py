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

import numpy as np
import tyro

from jumper_warp.cli.main import run_command
from jumper_warp.evaluation.landings import SUCCESS_TOLERANCE, Landings
from jumper_warp.evaluation.log import termination_names, within
from jumper_warp.evaluation.places import landing_metrics, random_headings, trained_range
from jumper_warp.evaluation.plots import draw_sweep, drawn
from jumper_warp.evaluation.run import EvaluationArgs, EvaluationRun
from jumper_warp.utils.errors import InputError

LOWER, UPPER = 0.3, 1.5
"""[m] Distances of the goals."""
IN_RANGE = (0.3, 1.4)
"""[m] Those that the paper reaches always."""
TRAINED = (0.4, 1.0)
"""[m] Those of the paper's training."""
PAPER = {"mean_error_m": 0.026, "success_rate": 0.97, "success_rate_in_range": 1.0}
"""The paper's figures for this test, in its simulation."""


@dataclass(frozen=True)
class Args(EvaluationArgs):
    """Flags."""

    jumps: int = 200
    """Number of jumps, one world each."""
    record: int = 5
    """Number of jumps to record for the Rerun viewer and, one of them, as a filmstrip; 0: none."""

    def __post_init__(self) -> None:
        """Check the values."""
        super().__post_init__()
        if self.jumps < 3:
            raise InputError(f"need at least 3 jumps, got {self.jumps}")


def metrics(landings: Landings) -> dict:
    """Return the metrics of the sweep."""
    distance = landings.goals[..., 0]
    values = landing_metrics(landings, within(distance, IN_RANGE))
    values["success_rate_0_4_1_0"] = float(landings.success[within(distance, TRAINED)].mean())
    return values


def main(args: Args) -> dict:
    """Run the sweep and return its figures."""
    run = EvaluationRun.of("horizontal_jump_sweep", args)
    goals = np.zeros((args.jumps, 1, 2))
    goals[:, 0, 0] = np.linspace(LOWER, UPPER, args.jumps)
    env = run.env(args.jumps)
    asked = Landings(goals, termination_names(env.task), random_headings(args.jumps, args.seed))
    landings = run.follow(env, asked, film="jumps")
    trained = trained_range(env.task)
    with drawn(run.folder / "sweep.png", figsize=(6, 5.5)) as axis:
        axis.axvspan(*TRAINED, color="0.5", alpha=0.08, label="training of the paper")
        axis.axvspan(*trained.values(), color="tab:orange", alpha=0.06, label="training of this policy")
        reached, good, names = landings.landing[:, 0, 0], landings.success[:, 0], ("landed there", "failed")
        draw_sweep(axis, goals[:, 0, 0], reached, good, SUCCESS_TOLERANCE, names)
        axis.set(xlabel="commanded distance [m]", ylabel="distance of the base at the end [m]")
        axis.set(title=f"{args.jumps} jumps, {run.title}", xlim=(LOWER - 0.05, UPPER + 0.05))
    return run.report(metrics(landings) | trained, PAPER)


if __name__ == "__main__":
    run_command(lambda: main(tyro.cli(Args)))
