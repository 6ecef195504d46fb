"""Measure how many inverse kinematics the device solves a second, and write metrics.

    python experiments/benchmark_ik.py --out outputs/benchmark_ik

One launch solves the legs of many robots, for reachable and for scattered paw targets. The results are checked before
the timing: every paw position of a pose within the limits must be reached.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import warp as wp

from jumper_warp.robot.description import load_description
from jumper_warp.utils.output import output_dir
from jumper_warp.utils.runtime import configure_device
from support.inverse_kinematics import InverseKinematics, random_motors
from support.scripts import DeviceArgs, report, run_script
from support.timing import median_time


@dataclass(frozen=True)
class Args(DeviceArgs):
    """Flags of the benchmark of inverse kinematics."""

    poses: int = 65536  # Robots per launch, four legs each
    repeats: int = 5  # Number of timed launches; the median is reported
    scatter: float = 0.3
    """[m] Half edge of the cube around each paw's reachable position that the scattered targets fill."""
    seed: int = 0  # Seed of the poses


def main(args: Args) -> dict:
    """Time the inverse kinematics of many robots, write and return the metrics.

    Raises RuntimeError: a reachable target is not reached.
    """
    info, device, n = configure_device(args.device), wp.get_device(args.device), args.poses
    folder = output_dir("benchmark_ik", args.out)
    description, rng = load_description(), np.random.default_rng(args.seed)
    robots = InverseKinematics(description, n, device)
    paws = robots.paws(random_motors(description, n, rng))
    offset = rng.uniform(-args.scatter, args.scatter, (4, n, 3)).astype(np.float32)
    scattered = wp.array(paws.numpy() + offset, dtype=wp.vec3, device=device)
    robots.solve(paws)
    reached, max_residual = robots.reachable.numpy().mean(), float(robots.residual.numpy().max())
    if reached < 1.0 or not max_residual < 1.0e-5:
        raise RuntimeError(f"{100.0 * reached:.4f} % reached, residual {max_residual:.2e} m: the time means nothing")
    times = [median_time(lambda aim=aim: robots.solve(aim), device, repeats=args.repeats) for aim in (paws, scattered)]
    values = {
        "device": info.name, "poses": n, "reachable_time [ms]": 1.0e3 * times[0],
        "reachable_rate [poses/s]": n / times[0], "reachable_max_residual [m]": max_residual,
        "scattered_time [ms]": 1.0e3 * times[1], "scattered_reachable [%]": 100.0 * robots.reachable.numpy().mean(),
    }  # fmt: skip
    keys = ("reachable_rate [poses/s]", "reachable_time [ms]", "scattered_time [ms]")
    return report(args, folder, values, f"Inverse kinematics of {n:,} robots in one launch, {info.name}", keys)


if __name__ == "__main__":
    run_script(main, Args)
