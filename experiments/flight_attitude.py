"""Compare landings on Mars with and without a policy that levels the robot in flight, and write metrics and plots.

    python experiments/flight_attitude.py --policy attitude --num-flights 100 --out outputs/flight
    python experiments/flight_attitude.py --takeoff policy --landing-policy mars_vertical_jump --randomize

Robots squat and extend their legs (24.8 N m, kp 20, 3.71 m/s^2). Some legs extend a few milliseconds later than others,
so that robots take off tilted and rotating. In flight a policy trained in zero gravity turns the robot to level. The
landing begins 0.35 s before touchdown, with the policy `--landing-policy` or in the default pose. A landing succeeds if
only paws touch the ground and the base is within 30 degrees of level 1.5 s later. The same takeoffs without turning are
the comparison. With `--takeoff policy` the landing policy also takes off, half a second after the start. A recording
and a picture show one flight of each kind.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from jumper_warp.evaluation.run import EvaluationArgs
from jumper_warp.utils.errors import InputError
from support.flights import FlightLog, FlightRun, extension_delays, flight_metrics, plot_flights
from support.scripts import run_script

SUMMARY = (
    "landed_upright_rate", "without_turning_landed_upright_rate", "touchdown_tilt_mean_deg",
    "without_turning_touchdown_tilt_mean_deg", "takeoff_tilt_mean_deg", "apex_mean_m",
)  # fmt: skip


@dataclass(frozen=True)
class Args(EvaluationArgs):
    """Flags of the comparison of flights with and without a policy that levels the robot."""

    policy: str = "attitude"  # Name or folder of the policy that turns, a run's folder, or a checkpoint
    landing_policy: str = ""
    """Policy that jumps to heights and lands: name, folder, run or checkpoint (default: the default pose)."""
    jump_task: str = "vertical-jump-mars"  # Task that takes off and lands, unless `landing_policy` is given
    num_flights: int = 60  # Number of flights
    max_leg_delay: float = 15.0  # [ms] Largest delay with which the legs of one end, or side, extend after the others
    takeoff: Literal["open-loop", "policy"] = "open-loop"
    """How robots take off: open loop, with legs that extend unequally, or by the policy that lands."""
    height_range: tuple[float, float] = (2.5, 2.5)
    """[m] Lowest and highest base height commanded to the policy that lands."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.num_flights < 1 or not 0.0 <= self.max_leg_delay <= 100.0:
            values = f"{self.num_flights}, {self.max_leg_delay}"
            raise InputError(f"need at least one flight, and max_leg_delay in 0 to 100 ms, got {values}")
        if not 0.3 <= self.height_range[0] <= self.height_range[1] <= 10.0:
            raise InputError(f"height_range must be in 0.3 to 10 m and rise, got {self.height_range}")
        if self.takeoff == "policy" and not self.landing_policy:
            raise InputError("takeoff by a policy needs one: --landing-policy")


def main(args: Args) -> dict:
    """Simulate the same flights with and without the turning policy, plot tilts and heights, and return the metrics."""
    run = FlightRun(args, args.landing_policy, args.jump_task)
    env, heights = run.env(args.num_flights), np.linspace(*args.height_range, args.num_flights)
    max_delay = 1.0e-3 * args.max_leg_delay
    late = extension_delays(args.num_flights, max_delay, args.stream_seed) if args.takeoff == "open-loop" else None
    flights = {
        name: run.fly(env, FlightLog(heights, late, turns=name == "turning"), name) for name in ("turning", "without")
    }
    plot_flights(run.folder / "flights.png", flights, run.title)
    settings = {"takeoff": args.takeoff, "landing": args.landing_policy or "default pose"}
    run.settings |= settings | ({} if late is None else {"late_ms": args.max_leg_delay})
    values = flight_metrics(flights["turning"])
    values |= {f"without_turning_{name}": value for name, value in flight_metrics(flights["without"]).items()}
    return run.report(values, {}, SUMMARY)


if __name__ == "__main__":
    run_script(main, Args)
