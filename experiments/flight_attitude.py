"""Attitude control in long flights on Mars: tilted takeoffs and their landings, with and without a turning policy.

    python experiments/flight_attitude.py --policy attitude --flights 100 --out outputs/flight
    python experiments/flight_attitude.py --takeoff policy --landing mars_vertical_jump --randomize

Robots squat and extend their legs (24.8 N m, kp 20, 3.71 m/s^2), some legs a few milliseconds later than others, so
that they take off tilted and rotating. In flight a policy trained to turn in zero gravity takes over, with the level
orientation as its goal. 0.35 s before the landing the jump takes over again: the policy `--landing`, or the default
pose. A landing succeeds if only paws touch the ground and the base is within 30 degrees of level 1.5 s later. The same
takeoffs without turning are the comparison. With `--takeoff policy` the landing policy also takes off, half a second
after the start.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
import tyro

from jumper_warp.cli.main import run_command
from jumper_warp.evaluation.run import EvaluationArgs
from jumper_warp.utils.errors import InputError
from support.flights import FlightLog, FlightRun, extension_delays, flight_metrics, plot_flights


@dataclass(frozen=True)
class Args(EvaluationArgs):
    """Flags."""

    policy: str = "attitude"
    """Name or folder of the policy that turns, a run's folder, or a checkpoint."""
    landing: str = ""
    """The same of a policy that jumps to heights and lands (default: none, the default pose)."""
    jump: str = "vertical-jump-mars"
    """Task that takes off and lands, unless `landing` is given."""
    flights: int = 60
    """Number of flights."""
    late: float = 15.0
    """[ms] Most by which the legs of one end, or side, extend later than the others."""
    takeoff: Literal["open-loop", "policy"] = "open-loop"
    """How robots take off: with legs that extend unequally, or by the policy that lands."""
    heights: tuple[float, float] = (2.5, 2.5)
    """[m] Lowest and highest that the policy which lands is told."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.flights < 1 or not 0.0 <= self.late <= 100.0:
            raise InputError(f"need at least one flight, and late in 0 to 100 ms, got {self.flights}, {self.late}")
        if not 0.3 <= self.heights[0] <= self.heights[1] <= 10.0:
            raise InputError(f"heights must be in 0.3 to 10 m and rise, got {self.heights}")
        if self.takeoff == "policy" and not self.landing:
            raise InputError("takeoff by a policy needs one: --landing")


def main(args: Args) -> dict:
    """Run the flights with and without turning, and return the metrics."""
    run = FlightRun(args, args.landing, args.jump)
    env, heights = run.env(args.flights), np.linspace(*args.heights, args.flights)
    late = extension_delays(args.flights, 1.0e-3 * args.late, args.seed) if args.takeoff == "open-loop" else None
    flights = {
        name: run.fly(env, FlightLog(heights, late, turns=name == "turning"), name) for name in ("turning", "without")
    }
    plot_flights(run.folder / "flights.png", flights)
    settings = {"takeoff": args.takeoff, "landing": args.landing or "default pose"}
    values = settings | ({} if late is None else {"late_ms": args.late}) | flight_metrics(flights["turning"])
    values |= {f"without_turning_{name}": value for name, value in flight_metrics(flights["without"]).items()}
    return run.report(values, {})


if __name__ == "__main__":
    run_command(lambda: main(tyro.cli(Args)))
