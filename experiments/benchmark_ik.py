"""Inverse kinematics of whole robots per second, in one launch, for reachable and for scattered paw targets.

    python experiments/benchmark_ik.py --out outputs/benchmark_ik

Before anything is timed the answer is checked: every paw position that a pose within limits takes is reached.
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import tyro
import warp as wp

from jumper_warp.robot.description import RobotDescription, load_description
from jumper_warp.robot.model import MOTOR_JOINTS, leg_geometry_array
from jumper_warp.utils.output import output_dir, write_figures
from jumper_warp.utils.runtime import report_device
from kernels.kinematics import geometry
from kernels.kinematics.inverse import LegLimits, inverse_kinematics_kernel
from kernels.kinematics.leg import leg_forward_kinematics


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
    """Folder for figures.json (default: outputs/benchmark_ik/<time>)."""
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
    lateral, outer = joints[MOTOR_JOINTS[0]], joints[MOTOR_JOINTS[1]]
    limits = LegLimits()
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


class Launch:
    """The inverse kinematics of a batch on one device."""

    def __init__(self, legs: wp.array, limits: LegLimits, n: int, device: wp.Device) -> None:
        self.legs, self.limits, self.n, self.device = legs, limits, n, device
        self.base_pos = wp.zeros(n, dtype=wp.vec3, device=device)
        self.base_quat = wp.zeros(n, dtype=wp.quat, device=device)
        self.motors, self.knees = (wp.zeros((rows, n), dtype=float, device=device) for rows in (12, 8))
        self.reachable = wp.zeros((4, n), dtype=wp.int32, device=device)
        self.residual = wp.zeros((4, n), dtype=float, device=device)

    def __call__(self, paws: wp.array) -> float:
        """Solve for paws (4, n) [m] in the body frame and return the wall time [s]."""
        wp.synchronize_device(self.device)
        start = time.perf_counter()
        wp.launch(
            inverse_kinematics_kernel,
            (4, self.n),
            [self.legs, self.limits, self.base_pos, self.base_quat, paws, 0],
            [self.motors, self.knees, self.reachable, self.residual],
            device=self.device,
        )
        wp.synchronize_device(self.device)
        return time.perf_counter() - start


def main(args: Args) -> dict:
    """Run the benchmark and return its figures."""
    wp.config.log_level = wp.LOG_WARNING
    info = report_device(args.device)
    folder = output_dir("benchmark_ik", args.out)
    device = wp.get_device(args.device)
    description = load_description()
    legs = leg_geometry_array(description, geometry, device)
    limits = leg_limits(description)
    rng = np.random.default_rng(args.seed)
    motors = wp.array(random_motors(limits, args.poses, rng).astype(np.float32), dtype=float, device=device)
    paws = wp.zeros((4, args.poses), dtype=wp.vec3, device=device)
    wp.launch(paws_kernel, (4, args.poses), [legs, motors], [paws], device=device)
    offset = rng.uniform(-args.scatter, args.scatter, (4, args.poses, 3)).astype(np.float32)
    scattered = wp.array(paws.numpy() + offset, dtype=wp.vec3, device=device)

    launch = Launch(legs, limits, args.poses, device)
    launch(paws)
    reached, residual = launch.reachable.numpy().mean(), launch.residual.numpy().max()
    if reached < 1.0 or not residual < 1.0e-5:
        raise RuntimeError(f"{100.0 * reached:.4f} % reached, residual {residual:.2e} m: the time means nothing")
    reachable_time = float(np.median([launch(paws) for _ in range(args.repeats)]))
    scattered_time = float(np.median([launch(scattered) for _ in range(args.repeats)]))
    figures = {
        "device": info.name,
        "poses": args.poses,
        "reachable_time [ms]": 1.0e3 * reachable_time,
        "reachable_rate [poses/s]": args.poses / reachable_time,
        "reachable_max_residual [m]": residual,
        "scattered_time [ms]": 1.0e3 * scattered_time,
        "scattered_reachable [%]": 100.0 * launch.reachable.numpy().mean(),
    }
    write_figures(folder, figures)
    for name, value in figures.items():
        print(f"{name:28} {value if isinstance(value, str) else f'{value:.6g}'}")
    print(f"figures in {folder}")
    return figures


if __name__ == "__main__":
    main(tyro.cli(Args))
