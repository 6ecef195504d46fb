"""Measure how well identification finds the known parameters of simulated robots; write metrics, a plot and overlays.

    python experiments/identification.py --num-matched 20 --out outputs/identification

Robots are sampled from the priors. Each executes two hung chirps, a standing chirp and a small jump, 1.25 s each. The
motions are recorded with noise (0.05 deg, 1 deg/s at 240 Hz; 5 mm, 0.5 deg at 120 Hz), and the robot is weighed (20 g).
Initial states are unknown. A jump at 16 N m instead of 12 is held out: its angles and height are predicted from the
targets alone.

`--parts`: `same` identifies with the simulator that recorded. `fine` and `rough` record with a finer step, `mujoco` on
SolverMuJoCo. `methods` compares CMA-ES and SciPy. `policy` predicts the jumps of a policy.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Any, Literal, get_args

import numpy as np

from jumper_warp.identification.parameters import jumper_parameters
from jumper_warp.identification.recording import KINDS, replay_plan, simulate_plan
from jumper_warp.identification.replay import MotionReplay
from jumper_warp.utils.errors import InputError
from jumper_warp.utils.output import output_dir
from jumper_warp.utils.runtime import configure_device
from support.identification_methods import compare_methods
from support.known_robots import make_case, plot_cases, policy_errors, run_case
from support.scripts import OutputArgs, report, run_script, tracked

SUMMARY = (
    "coverage", "kp_worst_percent", "offset_worst_deg", "latency_us", "held_out_deg", "held_out_nominal_deg",
    "held_out_mm", "held_out_nominal_mm", "wall_s",
)  # fmt: skip
REFINE = 16  # Physics steps of the finer truth per step of the model
Part = Literal["same", "fine", "rough", "mujoco", "methods", "policy"]


@dataclass(frozen=True)
class Args(OutputArgs):
    """Flags of the test of identification on simulated robots with known parameters."""

    num_matched: int = 20  # Number of robots that are identified with the simulator that recorded them
    num_mismatched: int = 1
    """Number of robots recorded on another simulator, for each of the parts fine, rough, mujoco; metrics: the first."""
    parts: tuple[Part, ...] = get_args(Part)  # Parts to run
    fine_dt: float = 1.0 / 3840.0
    """[s] Physics step of the model that identifies the robot recorded at a sixteenth of 1/480 s; "rough": 1/480."""
    policy: str = "vertical_jump"  # Policy whose jumps the identified robot is to predict
    num_jumps: int = 64  # Number of jumps to predict
    threads: int | None = None  # CPU threads (default: all cores)

    def __post_init__(self) -> None:
        if self.num_matched < 1 or self.num_mismatched < 1 or self.num_jumps < 3:
            values = f"{self.num_matched}, {self.num_mismatched}, {self.num_jumps}"
            raise InputError(f"need at least 1 robot of either kind and 3 jumps, got {values}")


def main(args: Args) -> dict[str, Any]:
    """Identify simulated robots and test the predictions, in the parts `args.parts`; write and return the metrics.

    The computation is on the CPU.
    """
    configure_device("cpu", args.threads)
    folder, parameters = output_dir("identification", args.out), jumper_parameters()
    replay = MotionReplay(device="cpu", threads=args.threads)
    ours = partial(replay_plan, MotionReplay(device="cpu", threads=1))  # simulates a plan with this project's step
    fine_steps = max(1, round(1.0 / 480.0 / args.fine_dt))
    simulate_finely, replay_finely = (partial(ours, refine=n) for n in (REFINE, fine_steps))
    values: dict[str, Any] = {"parameters": len(parameters), "seconds_of_data": 1.25 * len(KINDS)}

    cases = []
    matched = range(args.num_matched if {"same", "methods", "policy"} & set(args.parts) else 0)
    for seed in tracked(matched, "identifying robots"):
        case = make_case(parameters, seed, ours, replay)
        cases.append((case, *run_case(parameters, case, replay, ours)))
    rows = [metrics for _, metrics, _ in cases]
    if rows:
        values |= {name: float(np.median([row[name] for row in rows])) for name in rows[0]}
        values["coverage"] = float(np.mean([row["coverage"] for row in rows]))
        values |= {f"{name}_of_seeds": [row[name] for row in rows] for name in ("chi2", "wall_s", "cpu_s", "coverage")}
    # part: truth that is recorded, model that identifies it, its physics step [s] (None: the default)
    mismatched = {"fine": (simulate_finely, replay_finely, args.fine_dt), "rough": (simulate_finely, ours, None),
              "mujoco": (partial(simulate_plan, solver="mujoco"), ours, None)}  # fmt: skip
    for part, (simulate, model, dt) in mismatched.items():
        if part in args.parts:
            results = []
            for seed in tracked(range(100, 100 + args.num_mismatched), f"identifying robots, {part}"):
                case = make_case(parameters, seed, simulate, replay)
                results.append(run_case(parameters, case, replay, model, dt)[0])
            values |= {f"{part}_{name}": value for name, value in results[0].items()}
            values |= {f"{part}_{name}_of_seeds": [row[name] for row in results] for name in ("coverage", "identified")}
    if "methods" in args.parts:
        values |= compare_methods(parameters, cases[0][0], replay, ours, cases[0][2].effort.seconds)
    if "policy" in args.parts:
        values |= policy_errors(args.policy, args.num_jumps, cases[0][0], cases[0][2], folder)
    if rows:
        plot_cases(rows, folder / "identification.png")
    return report(args, folder, values, f"Identification of {len(rows)} known robots: medians", SUMMARY)


if __name__ == "__main__":
    run_script(main, Args)
