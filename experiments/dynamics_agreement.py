"""Compare accelerations, paw positions and paw Jacobians with Pinocchio, and write the differences as metrics.

    python experiments/dynamics_agreement.py --robot assets/jumper/leg_springs.json --out outputs/dynamics_agreement

The states are random flight states with random motor torques. Both robots have the masses and armatures of the
description or of an overlay, without ground, friction, knee damping and springs. The project's dynamics compute in
double precision with masses that Newton's model stores in single precision, so seven digits can agree. A relative
difference is the difference over the largest value of the same state.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from jumper_warp.robot.overlay import load_overlay
from jumper_warp.robot.values import RobotValues
from jumper_warp.utils.errors import InputError
from jumper_warp.utils.output import output_dir
from jumper_warp.utils.runtime import configure_device
from support.agreement import jumper_quantities, pinocchio_quantities, random_states
from support.scripts import OutputArgs, report, run_script

UNITS = {  # by quantity of `support.agreement`
    "base_acceleration": "m/s^2",
    "base_angular_acceleration": "rad/s^2",
    "joint_acceleration": "rad/s^2",
    "paw_position": "m",
    "paw_jacobian": "m",  # per rad
}


@dataclass(frozen=True)
class Args(OutputArgs):
    """Flags of the comparison of dynamics with Pinocchio."""

    robot: Path | None = None  # Robot overlay (docs/reference/overlays.md; default: the robot as described)
    states: int = 200  # Number of random states
    seed: int = 0  # Seed of the states

    def __post_init__(self) -> None:
        if self.states < 1:
            raise InputError(f"states must be at least 1, got {self.states}")


def differences(ours: np.ndarray, expected: np.ndarray) -> tuple[float, float]:
    """Compare arrays of one quantity: return the largest difference over all states, absolute and relative.

    A relative difference is the difference over the state's largest value.
    ours, expected: (states, ...) values of one quantity in its unit.
    """
    size, difference = (np.abs(rows.reshape(len(rows), -1)).max(axis=1) for rows in (expected, ours - expected))
    return float(difference.max()), float((difference / size).max())


def main(args: Args) -> dict:
    """Compare accelerations, paw positions and paw Jacobians with Pinocchio, and return the metrics."""
    configure_device("cpu")
    folder = output_dir("dynamics_agreement", args.out)
    values = RobotValues.nominal(1) if args.robot is None else load_overlay(args.robot).robots()
    states = random_states(args.states, args.seed)
    ours, expected = jumper_quantities(values, states), pinocchio_quantities(values, states)
    metrics: dict = {"states": args.states, "robot": None if args.robot is None else str(args.robot)}
    for name, unit in UNITS.items():
        difference, relative = differences(ours[name], expected[name])
        metrics |= {f"{name}_difference [{unit}]": difference, f"{name}_relative_difference": relative}
    keys = [f"{name}_relative_difference" for name in UNITS]
    return report(args, folder, metrics, f"Dynamics of {args.states} random states against Pinocchio", keys)


if __name__ == "__main__":
    run_script(main, Args)
