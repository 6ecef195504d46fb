"""Inverse kinematics of whole robots per second, in one launch, for reachable and for scattered paw targets.

    python experiments/benchmark_ik.py --out outputs/benchmark_ik

Before anything is timed the answer is checked: every paw position that a pose within limits takes is reached.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import tyro
import warp as wp

from jumper_warp.cli.main import run_command
from jumper_warp.kernels.kinematics import geometry
from jumper_warp.kernels.kinematics.inverse import LegLimits, inverse_kinematics_kernel
from jumper_warp.kernels.kinematics.leg import leg_forward_kinematics
from jumper_warp.robot.description import RobotDescription, load_description
from jumper_warp.robot.model import MOTOR_JOINTS, leg_geometry_array
from jumper_warp.utils.output import output_dir, write_metrics
from jumper_warp.utils.runtime import announce
from support.timing import median_time


@dataclass(frozen=True)
class Args:
    """Flags."""

    poses: int = 65536
    """Robots per launch, four legs each."""
    repeats: int = 5
    """Timed launches; the median counts."""
    scatter: float = 0.3
    """Half edge [m] of the cube around each paw's reachable position that the scattered targets fill."""
    seed: int = 0
    out: Path | None = None
    """Folder for metrics.json (default: outputs/benchmark_ik/<time>)."""
    device: str | None = None
    """Warp device."""


@wp.kernel(enable_backward=False)
def paws_kernel(
    # in
    legs: wp.array(dtype=geometry.LegGeometry),
    motors: wp.array2d(dtype=float),
    # out
    paws: wp.array2d(dtype=wp.vec3),
):
    """Write paw positions [m] (4, n) in the body frame for motor angles [rad] (12, n)."""
    leg, robot = wp.tid()
    m = 3 * leg
    paws[leg, robot] = leg_forward_kinematics(legs[leg], motors[m, robot], motors[m + 1, robot], motors[m + 2, robot])


def leg_limits(description: RobotDescription) -> LegLimits:
    """Return the hard stops of a leg."""
    joints = {joint.name: joint for joint in description.joints}
    lateral, outer, limits = joints[MOTOR_JOINTS[0]], joints[MOTOR_JOINTS[1]], LegLimits()
    limits.lateral_lower, limits.lateral_upper = lateral.lower, lateral.upper
    limits.transversal_lower, limits.transversal_upper = outer.lower, outer.upper
    limits.sum_lower, limits.sum_upper = description.transversal_sum
    return limits


def random_motors(limits: LegLimits, n: int, rng: np.random.Generator) -> np.ndarray:
    """Return motor angles [rad] within limits, shape (12, n)."""
    lateral = rng.uniform(limits.lateral_lower, limits.lateral_upper, (4, 1, n))
    outer = rng.uniform(limits.transversal_lower, limits.transversal_upper, (4, 1, n))
    lowest = np.maximum(limits.transversal_lower, limits.sum_lower - outer)
    highest = np.minimum(limits.transversal_upper, limits.sum_upper - outer)
    return np.concatenate([lateral, outer, rng.uniform(lowest, highest)], axis=1).reshape(12, n)


def main(args: Args) -> dict:
    """Run the benchmark and return its figures."""
    info, device, n = announce(args.device), wp.get_device(args.device), args.poses
    folder = output_dir("benchmark_ik", args.out)
    description = load_description()
    legs, limits = leg_geometry_array(description, geometry, device), leg_limits(description)
    rng = np.random.default_rng(args.seed)
    motors = wp.array(random_motors(limits, n, rng).astype(np.float32), dtype=float, device=device)
    paws = wp.zeros((4, n), dtype=wp.vec3, device=device)
    wp.launch(paws_kernel, (4, n), [legs, motors], [paws], device=device)
    offset = rng.uniform(-args.scatter, args.scatter, (4, n, 3)).astype(np.float32)
    scattered = wp.array(paws.numpy() + offset, dtype=wp.vec3, device=device)
    base = [wp.zeros(n, dtype=kind, device=device) for kind in (wp.vec3, wp.quat)]
    found = [wp.zeros((rows, n), dtype=float, device=device) for rows in (12, 8)]
    reachable, residual = (wp.zeros((4, n), dtype=kind, device=device) for kind in (wp.int32, float))

    def solve(targets: wp.array) -> None:
        inputs, outputs = [legs, limits, *base, targets, 0], [*found, reachable, residual]
        wp.launch(inverse_kinematics_kernel, (4, n), inputs, outputs, device=device)

    solve(paws)
    reached, farthest = reachable.numpy().mean(), residual.numpy().max()
    if reached < 1.0 or not farthest < 1.0e-5:
        raise RuntimeError(f"{100.0 * reached:.4f} % reached, residual {farthest:.2e} m: the time means nothing")
    times = [median_time(lambda aim=aim: solve(aim), device, repeats=args.repeats) for aim in (paws, scattered)]
    figures = {
        "device": info.name,
        "poses": n,
        "reachable_time [ms]": 1.0e3 * times[0],
        "reachable_rate [poses/s]": n / times[0],
        "reachable_max_residual [m]": farthest,
        "scattered_time [ms]": 1.0e3 * times[1],
        "scattered_reachable [%]": 100.0 * reachable.numpy().mean(),
    }
    write_metrics(folder, figures)
    for name, value in figures.items():
        print(f"{name:28} {value if isinstance(value, str) else f'{value:.6g}'}")
    print(f"figures in {folder}")
    return figures


if __name__ == "__main__":
    run_command(lambda: main(tyro.cli(Args)))
