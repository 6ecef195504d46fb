"""Optimise jumps by gradients through the simulation, and write metrics, plots, targets and recordings of the best.

    python experiments/trajectory_optimization.py --out outputs/trajectories
    python experiments/trajectory_optimization.py --jumps farthest farthest_torque_24_8 farthest_filter

The jumps are the farthest flight, the highest jumps, the jump with the least work, and a still landing. Motor targets,
equal left and right, pass through the command filter and motors of the tasks, from standing still.

1. A search begins with random squats in parallel worlds, for the farthest flight with run-ups in place.
2. It descends along smoothed gradients (`trajectory.smoothing`).
3. It ends with limited-memory BFGS inside an augmented Lagrangian (`trajectory.augmented_lagrangian`).
4. The best targets are replayed in the simulation that trains policies. The metrics come from this replay, at every
   physics step; collisions of all links count.

The farthest flight stays within 0.3 m of its start in stance, without a run-up, and lands within 30 degrees of level.
`farthest_*` change one limit (`support.optimized_jumps.LIMITS`) and also start from the farthest flight if it was
optimised before. In vertical jumps only the paws touch the ground, the tilt is at most 8 degrees and the base stays
within 0.15 m of its start. Work is the motors' positive work until takeoff.
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

from jumper_warp.utils.arrays import write_npz
from jumper_warp.utils.errors import InputError
from jumper_warp.utils.output import write_metrics
from support.motion_replay import MotionReplay, plot_replays
from support.optimized_jumps import FINE, JUMPS, LIMITED, noisy_variants, optimise
from support.scripts import ThreadArgs, prepare, report, run_script, tracked

ALL_JUMPS = JUMPS | LIMITED  # By name


@dataclass(frozen=True)
class Args(ThreadArgs):
    """Flags of the optimisation of jumps."""

    jumps: tuple[str, ...] = tuple(JUMPS)  # Names of the jumps to optimise
    samples: int | None = None  # Random candidates (default: those of each jump)
    effort: float = 1.0  # [1] Factor on the number of iterations
    final_iterations: int | None = None  # Iterations of the last descent (default: those of each jump)
    seed: int = 0  # Seed of random candidates and displacements

    def __post_init__(self) -> None:
        unknown = [name for name in self.jumps if name not in ALL_JUMPS]
        if unknown or not self.jumps:
            raise InputError(f"no jump {(unknown or [''])[0]!r:.40}; there are {', '.join(ALL_JUMPS)}")
        if not self.effort > 0.0 or (self.final_iterations is not None and self.final_iterations < 1):
            raise InputError("need an iteration of the last descent, and an effort above 0")
        if self.samples is not None and self.samples < 48:
            raise InputError(f"need at least 48 samples, got {self.samples}")


def run_jump(name: str, args: Args, folder: Path, best: dict[str, np.ndarray]) -> tuple[dict[str, float], MotionReplay]:
    """Optimise the named jump, write its targets, and return metrics of the search and the replay.

    best: solutions (len(knots),) by name of the jump; one may start this search, and the new one is added.
    """
    jump, wall, cpu = ALL_JUMPS[name], time.perf_counter(), time.process_time()
    settings: dict[str, Any] = {"device": args.device, "threads": args.threads}
    knots, rng = jump.make(**FINE, **settings).knots, np.random.default_rng(args.seed)
    begin = jump.draw(knots, args.samples or jump.samples, rng)
    if jump.after in best:
        begin = np.concatenate([begin, noisy_variants(best[jump.after], knots, rng)])
    last = args.final_iterations or jump.polish
    progress, steps = optimise(jump.scaled(args.effort), begin, args.seed, last, **settings)
    x = best[name] = progress.x[progress.best]
    targets = knots.targets(torch.as_tensor(x[None]))[..., 0].numpy()
    write_npz(folder / f"{name}.npz", targets=targets, knots=x.reshape(len(knots.at), -1), at=np.array(knots.at))
    values = steps | {"wall_s": time.perf_counter() - wall, "cpu_s": time.process_time() - cpu}
    replay = jump.replay(targets, args.device)
    return values | {"value": jump.value(replay), "violation": replay.violation}, replay


def main(args: Args) -> dict[str, Any]:
    """Optimise the jumps in order, write their replays, and return the metrics."""
    torch.set_num_threads(1)  # arrays of torch are small; the simulated worlds use the cores
    folder, best = prepare("trajectory_optimization", args, args.threads), {}
    replays: dict[str, MotionReplay] = {}
    values: dict[str, Any] = {}
    for name in tracked(args.jumps, "optimising jumps"):
        row, replay = run_jump(name, args, folder, best)
        replays[ALL_JUMPS[name].label] = replay
        values |= {f"{name}_gradients_{key}": value for key, value in row.items()}
        values[f"{name}_reached [{ALL_JUMPS[name].unit}]"] = row["value"]
        values |= {f"{name}_{key}": value for key, value in replay.metrics().items()}
        if name == "still":
            values |= {"still_longest_lift_s": replay.longest_lift, "still_highest_lift_m": replay.highest_lift}
        replay.recorder.save_rrd(folder / f"{name}.rrd")
        replay.recorder.save_picture(folder / f"{name}.png", title=ALL_JUMPS[name].label)
        write_metrics(folder, values)
    plot_replays(replays, folder / "trajectories.png")
    keys = [key for key in values if "_reached [" in key or key.endswith("_violation")]
    return report(args, folder, values, f"Optimised jumps: {', '.join(replays)}", keys)


if __name__ == "__main__":
    run_script(main, Args)
