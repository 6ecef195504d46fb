"""What paws do after a landing: which are lifted again, for how long, and whether the robot takes off again."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from jumper_warp.evaluation.log import EvaluationEnv

HOP_TIME = 0.05
"""[s] A robot that is off the ground for longer after touchdown has jumped again; one that lifts a paw, which had come
down, for as long has stepped."""
TAKEOFF_SPEED = 0.25
"""[m/s] Upward speed of the base, with no paw down, of a second takeoff (authors' configuration)."""
TIME_EPS = 1.0e-6
"""[s] Rounding of sums of steps."""


class Lifted(NamedTuple):
    """What a policy step after touchdown showed; arrays have shape (rows,)."""

    aloft: np.ndarray
    """[s] How long no paw has been on the ground."""
    paw: np.ndarray
    """[s] How long the paw has been off the ground that is so longest, of those that had come down."""
    takeoff: np.ndarray
    """Whether the robot has just taken off again."""


class Paws:
    """Follows the paws of landed robots; what was before a touchdown is forgotten."""

    def __init__(self, count: int) -> None:
        """count: of worlds."""
        self._aloft, self._lifted = np.zeros(count), np.zeros((count, 4))
        self._came_down, self._flies = np.zeros((count, 4), dtype=bool), np.zeros(count, dtype=bool)

    def update(
        self, row: np.ndarray, landed: np.ndarray, paws_down: np.ndarray, up: np.ndarray, step_dt: float
    ) -> Lifted:
        """Take in a policy step of some worlds.

        row: indices of worlds, (rows,); landed: whether they are after a touchdown, (rows,); paws_down: (rows, 4);
        up: upward speed of the base [m/s], (rows,); step_dt [s].
        """
        down = landed[:, None] & paws_down
        aloft = landed & ~down.any(axis=1)
        self._aloft[row] = np.where(aloft, self._aloft[row] + step_dt, 0.0)
        self._came_down[row] = landed[:, None] & (self._came_down[row] | down)
        self._lifted[row] = np.where(self._came_down[row] & ~down, self._lifted[row] + step_dt, 0.0)
        flies = aloft & (self._flies[row] | (up > TAKEOFF_SPEED))
        takeoff = flies & ~self._flies[row]
        self._flies[row] = flies
        return Lifted(self._aloft[row], self._lifted[row].max(axis=1), takeoff)


def paw_arrays(env: EvaluationEnv) -> dict[str, np.ndarray]:
    """Return what `Paws` follows: which paws are on the ground, (num_envs, 4), and the base's upward speed [m/s]."""
    force = np.linalg.norm(env.sim.paw_force.numpy(), axis=2)
    return {"paws_down": (force > env.task.contact_force).T, "up": env.sim.base_velocity()[:, 2]}


def stepped(lift_time: np.ndarray) -> np.ndarray:
    """Return whether a paw was lifted again for HOP_TIME or longer; lift_time [s]."""
    return lift_time > HOP_TIME - TIME_EPS


def hopped(air_time: np.ndarray) -> np.ndarray:
    """Return whether all paws were lifted again for longer than HOP_TIME; air_time [s]."""
    return air_time > HOP_TIME + TIME_EPS
