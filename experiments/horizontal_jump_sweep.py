"""The paper's test of the horizontal jump: a policy jumps 0.3 to 1.5 m straight ahead, spread evenly, each once.

    python experiments/horizontal_jump_sweep.py --policy horizontal_jump --jumps 200 --out outputs/sweep

Every robot stands in the default pose, with a heading of its own drawn from the full circle, and is told to jump after
half a second. The error is the distance of the base from its goal in the plane a second after touchdown, or where the
jump failed before. A jump succeeds if it was begun on command, ends within 0.1 m of its goal, and nothing but the paws
touched anything; a landing may go on with steps, a second hop or a second takeoff (upward at 0.25 m/s with no paw
down), which are told apart. `--end-at-second-takeoff` ends the jump there, as in the authors' configuration. `--rest`
follows landed robots for longer. `--randomize` adds the randomisation, noise and latency of the training, and pushes
that come and go while a paw is on the ground; a second test has them in flight too. `--solver mujoco` is a check
against physics that the policy was not trained on.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import tyro

from jumper_warp.cli.main import run_command
from jumper_warp.evaluation.jumps import REST_TIME
from jumper_warp.evaluation.landings import SUCCESS_TOLERANCE, Landings, ended_by_takeoff, for_evaluation
from jumper_warp.evaluation.log import mean, termination_names, within
from jumper_warp.evaluation.places import landing_metrics, random_headings, trained_range
from jumper_warp.evaluation.plots import draw_sweep, drawn
from jumper_warp.evaluation.run import EvaluationArgs, EvaluationRun
from jumper_warp.policies.conditions import Conditions
from jumper_warp.utils.errors import InputError

LOWER, UPPER = 0.3, 1.5
"""[m] Distances of the goals."""
IN_RANGE = (0.3, 1.4)
"""[m] Those that the paper reaches always."""
TRAINED = (0.4, 1.0)
"""[m] Those of the paper's training."""
PAPER = {"mean_error_m": 0.026, "success_rate": 0.97, "success_rate_in_range": 1.0}
"""The paper's figures for this test, in its simulation."""
IN_FLIGHT = (
    "mean_error_m", "success_rate", "success_rate_in_range", "fall_rate", "miss_rate", "still_landing_rate",
    "max_landing_tilt_deg",
)  # fmt: skip
"""Figures of the test whose pushes act in flight too."""


@dataclass(frozen=True)
class Args(EvaluationArgs):
    """Flags."""

    jumps: int = 200
    """Number of jumps, one world each."""
    distances: tuple[float, float] = (LOWER, UPPER)
    """[m] Of the nearest and the farthest goal."""
    aside: float = 0.0
    """[m] Goals lie up to this far to either side, drawn."""
    rest: float = REST_TIME
    """[s] From touchdown until a jump is over."""
    end_at_second_takeoff: bool = False
    """A second takeoff after landing ends a jump, as a failure."""
    record: int = 5
    """Number of jumps to record for the Rerun viewer and, one of them, as a filmstrip; 0: none."""

    def __post_init__(self) -> None:
        """Check the values."""
        super().__post_init__()
        if self.jumps < 3:
            raise InputError(f"need at least 3 jumps, got {self.jumps}")
        if not 0.1 <= self.rest <= 10.0:
            raise InputError(f"rest must be in [0.1, 10] s, got {self.rest}")
        if not 0.0 < self.distances[0] < self.distances[1] < 10.0 or not 0.0 <= self.aside < 10.0:
            raise InputError(f"goals must be within 10 m and distances rise, got {self.distances}, {self.aside} aside")


def metrics(landings: Landings) -> dict:
    """Return the metrics of the sweep."""
    distance = landings.goals[..., 0]
    values = landing_metrics(landings, within(distance, IN_RANGE))
    values["success_rate_0_4_1_0"] = mean(landings.success[within(distance, TRAINED)])
    return values


def follow(run: EvaluationRun, args: Args, conditions: Conditions, film: str = "") -> Landings:
    """Return the jumps, as they came out in some conditions."""
    goals = np.zeros((args.jumps, 1, 2))
    goals[:, 0, 0] = np.linspace(*args.distances, args.jumps)
    goals[:, 0, 1] = np.random.default_rng(args.seed + 1).uniform(-args.aside, args.aside, args.jumps)
    env = run.env(args.jumps, ended_by_takeoff if args.end_at_second_takeoff else for_evaluation, conditions)
    headings = random_headings(args.jumps, args.seed)
    return run.follow(env, Landings(goals, termination_names(env.task), headings, rest=args.rest), film=film)


def main(args: Args) -> dict:
    """Run the sweep and return its figures."""
    run = EvaluationRun.of("horizontal_jump_sweep", args)
    landings, trained = follow(run, args, run.conditions, "jumps"), trained_range(run.task)
    values = {"rest_s": args.rest, "end_at_second_takeoff": args.end_at_second_takeoff, **metrics(landings), **trained}
    with drawn(run.folder / "sweep.png", figsize=(6, 5.5)) as axis:
        axis.axvspan(*TRAINED, color="0.5", alpha=0.08, label="training of the paper")
        axis.axvspan(*trained.values(), color="tab:orange", alpha=0.06, label="training of this policy")
        reached, good, names = landings.landing[:, 0, 0], landings.success[:, 0], ("landed there", "failed")
        draw_sweep(axis, landings.goals[:, 0, 0], reached, good, SUCCESS_TOLERANCE, names)
        axis.set(xlabel="commanded distance [m]", ylabel="distance of the base at the end [m]")
        axis.set(xlim=(args.distances[0] - 0.05, args.distances[1] + 0.05))
        axis.set_title(f"{args.jumps} jumps, {run.title}", wrap=True)
    if args.randomize and not args.push_in_flight:
        again = metrics(follow(run, args, replace(run.conditions, push_in_flight=True)))
        values |= {f"pushed_in_flight_{name}": again[name] for name in IN_FLIGHT}
    return run.report(values, PAPER)


if __name__ == "__main__":
    run_command(lambda: main(tyro.cli(Args)))
