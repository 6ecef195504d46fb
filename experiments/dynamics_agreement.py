"""Comparison of the dynamics with Pinocchio: accelerations, paw positions and paw Jacobians of random flight states.

    python experiments/dynamics_agreement.py --robot assets/jumper/leg_springs.json --out outputs/dynamics_agreement

Both robots have the masses and armatures of the description or of an overlay and random motor torques, without ground,
friction, knee damping and springs. The project's dynamics compute in double precision with masses that Newton's model
stores in single precision, so seven digits can agree. A relative difference is the difference over the largest value of
the same state.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from jumper_warp.robot.overlay import load_overlay
from jumper_warp.robot.values import RobotValues
from jumper_warp.utils.errors import InputError
from jumper_warp.utils.output import output_dir, write_metrics
from jumper_warp.utils.runtime import configure_device
from support.agreement import jumper_quantities, pinocchio_quantities, random_states
from support.scripts import run_script

UNITS = {  # by quantity of `support.agreement`
    "base_acceleration": "m/s^2",
    "base_angular_acceleration": "rad/s^2",
    "joint_acceleration": "rad/s^2",
    "paw_position": "m",
    "paw_jacobian": "m",  # per rad
}


@dataclass(frozen=True)
class Args:
    """Flags."""

    robot: Path | None = None  # Robot overlay (docs/robot_overlays.md; default: the robot as described)
    states: int = 200  # Number of random states
    seed: int = 0  # Seed of the states
    out: Path | None = None  # Folder for metrics.json (default: outputs/dynamics_agreement/<time>)

    def __post_init__(self) -> None:
        if self.states < 1:
            raise InputError(f"states must be at least 1, got {self.states}")


def differences(ours: np.ndarray, expected: np.ndarray) -> tuple[float, float, float]:
    """Return three maxima over states: expected value, difference, and difference over the state's largest value.

    ours, expected: (states, ...) values of one quantity in its unit.
    """
    size, difference = (np.abs(rows.reshape(len(rows), -1)).max(axis=1) for rows in (expected, ours - expected))
    return float(size.max()), float(difference.max()), float((difference / size).max())


def main(args: Args) -> dict:
    """Compare all quantities, write and print their differences, and return the metrics."""
    configure_device("cpu")
    folder = output_dir("dynamics_agreement", args.out)
    values = RobotValues.nominal(1) if args.robot is None else load_overlay(args.robot).robots()
    states = random_states(args.states, args.seed)
    ours, expected = jumper_quantities(values, states), pinocchio_quantities(values, states)
    metrics: dict = {"states": args.states, "robot": None if args.robot is None else str(args.robot)}
    for name, unit in UNITS.items():
        size, difference, relative = differences(ours[name], expected[name])
        metrics |= {f"{name}_difference [{unit}]": difference, f"{name}_relative_difference": relative}
        print(f"{name:26} up to {size:.4g} {unit}, largest difference {difference:.1e} {unit}, relative {relative:.1e}")
    write_metrics(folder, metrics)
    print(f"metrics in {folder}")
    return metrics


if __name__ == "__main__":
    run_script(main, Args)
