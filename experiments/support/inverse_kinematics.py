"""Random poses and inverse kinematics of many robots, by direct launches of the kernels."""

from __future__ import annotations

from typing import Any

import numpy as np
import warp as wp

from jumper_warp.kernels.kinematics import geometry
from jumper_warp.kernels.kinematics.inverse import LegLimits, inverse_kinematics_kernel, paws_kernel
from jumper_warp.robot.description import MOTOR_JOINTS, RobotDescription
from jumper_warp.robot.model import leg_geometry_array


def random_motors(description: RobotDescription, n: int, rng: np.random.Generator, margin: float = 0.0) -> np.ndarray:
    """Return random motor angles [rad], (12, n), at least a margin [rad] away from the joint stops.

    They are uniform between the stops.
    Rows: legs FL, FR, BL, BR; each lateral, outer, inner. Outer and inner angles also respect the stops of their sum.
    """
    lateral, outer = (description.joint(name) for name in MOTOR_JOINTS[:2])
    lower, upper = (outer.lower + margin, outer.upper - margin)
    lateral_angle = rng.uniform(lateral.lower + margin, lateral.upper - margin, (4, 1, n))
    outer_angle = rng.uniform(lower, upper, (4, 1, n))
    lowest = np.maximum(lower, description.transversal_sum[0] + margin - outer_angle)
    highest = np.minimum(upper, description.transversal_sum[1] - margin - outer_angle)
    return np.concatenate([lateral_angle, outer_angle, rng.uniform(lowest, highest)], axis=1).reshape(12, n)


def leg_limits(description: RobotDescription) -> Any:
    """Return the hard stops [rad] of a leg, the struct `LegLimits`."""
    lateral, outer = (description.joint(name) for name in MOTOR_JOINTS[:2])
    limits = LegLimits()
    limits.lateral_lower, limits.lateral_upper = lateral.lower, lateral.upper
    limits.transversal_lower, limits.transversal_upper = outer.lower, outer.upper
    limits.sum_lower, limits.sum_upper = description.transversal_sum
    return limits


class InverseKinematics:
    """Forward and inverse kinematics of the legs FL, FR, BL, BR of n robots."""

    def __init__(self, description: RobotDescription, n: int, device: wp.Device) -> None:
        """Allocate the results of the kinematics of n robots on a device."""
        self._legs, self._limits = leg_geometry_array(description, geometry, device), leg_limits(description)
        self._base = [wp.zeros(n, dtype=kind, device=device) for kind in (wp.vec3, wp.quat)]
        self._angles = [wp.zeros((rows, n), dtype=float, device=device) for rows in (12, 8)]
        self.reachable = wp.zeros((4, n), dtype=wp.int32, device=device)  # 1 where the last `solve` reached the target
        self.residual = wp.zeros((4, n), dtype=float, device=device)  # [m] distance to targets of the last `solve`

    def paws(self, motors: np.ndarray) -> wp.array:
        """Return paw positions [m], (4, n) vec3, body frame, at motor angles [rad], (12, n)."""
        device = self.residual.device
        angles = wp.array(motors.astype(np.float32), dtype=float, device=device)
        paws = wp.zeros(self.residual.shape, dtype=wp.vec3, device=device)
        wp.launch(paws_kernel, paws.shape, [self._legs, angles], [paws], device=device)
        return paws

    def solve(self, targets: wp.array) -> None:
        """Find the poses that put the paws at targets [m], (4, n) vec3, body frame; set `reachable` and `residual`."""
        inputs = [self._legs, self._limits, *self._base, targets, 0]
        outputs = [*self._angles, self.reachable, self.residual]
        wp.launch(inverse_kinematics_kernel, targets.shape, inputs, outputs, device=targets.device)
