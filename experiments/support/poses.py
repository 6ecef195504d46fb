"""Random poses of the robot."""

from __future__ import annotations

import numpy as np

from jumper_warp.robot.description import MOTOR_JOINTS, RobotDescription


def random_motors(description: RobotDescription, n: int, rng: np.random.Generator, margin: float = 0.0) -> np.ndarray:
    """Return motor angles [rad], shape (12, n), uniform between the stops, a margin [rad] away from them."""
    lateral, outer = (description.joint(name) for name in MOTOR_JOINTS[:2])
    least, most = (outer.lower + margin, outer.upper - margin)
    swing = rng.uniform(lateral.lower + margin, lateral.upper - margin, (4, 1, n))
    first = rng.uniform(least, most, (4, 1, n))
    lowest = np.maximum(least, description.transversal_sum[0] + margin - first)
    highest = np.minimum(most, description.transversal_sum[1] - margin - first)
    return np.concatenate([swing, first, rng.uniform(lowest, highest)], axis=1).reshape(12, n)
