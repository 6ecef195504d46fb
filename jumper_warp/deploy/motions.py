"""Motions without a policy: ramps between poses, the test of each leg's sign, and landing after a fault in flight."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from jumper_warp.deploy.skills import Motion

FLIGHT_TIME = 1.0  # [s] Longest flight after a fault; then the motors brake


class Ramp:
    """Motion through poses at constant speed of each joint, with equal time for each pose."""

    def __init__(self, start: np.ndarray, poses: Sequence[np.ndarray], seconds: float, dt: float) -> None:
        """Start at a pose (12,) [rad], and reach each of `poses` after `seconds`; dt: time of a tick [s]."""
        self._poses = [np.array(start, dtype=np.float32), *poses]
        self._ticks = max(1, round(seconds / dt))
        self._tick = 0

    @property
    def done(self) -> bool:
        """Whether the last pose is reached."""
        return self._tick >= self._ticks * (len(self._poses) - 1)

    def step(self, motion: Motion) -> np.ndarray:
        """Advance a tick and return the targets [rad], (12,)."""
        if not self.done:
            self._tick += 1
        if self.done:
            return self._poses[-1]
        part, tick = divmod(self._tick, self._ticks)
        fraction = np.float32(tick / self._ticks)
        return self._poses[part] + fraction * (self._poses[part + 1] - self._poses[part])


class SignTest:
    """Extend one leg after the other of a standing robot: the base must tilt away from it, else cables are swapped."""

    LEGS = ((1.0, 1.0), (1.0, -1.0), (-1.0, 1.0), (-1.0, -1.0))  # front, left of FL, FR, BL, BR
    ANGLE, SECONDS = 0.2, 0.4  # [rad] of outer and inner joint, [s] of each leg's motion, and as much to return
    LEAST = 0.004  # least change of gravity's direction [1] toward the opposite corner

    def __init__(self, default: np.ndarray, dt: float) -> None:
        """Start in the default pose (12,) [rad]; dt: time of a tick [s]."""
        self._default = default
        self._ticks = round(self.SECONDS / dt)
        self._tick = 0
        self._before = np.zeros(3)
        self.failed = False

    @property
    def done(self) -> bool:
        """Whether all legs have been tested."""
        return self._tick >= 8 * self._ticks

    def step(self, motion: Motion) -> np.ndarray:
        """Advance a tick and return the targets [rad], (12,)."""
        target = self._default.copy()
        if self.done:
            return target
        leg, tick = divmod(self._tick, 2 * self._ticks)
        self._tick += 1
        if tick == 0:
            self._before = motion.gravity
        out = tick < self._ticks
        fraction = tick / self._ticks if out else 2.0 - tick / self._ticks
        target[3 * leg + 1 : 3 * leg + 3] -= np.float32(self.ANGLE * fraction)
        if tick == self._ticks:
            change = motion.gravity - self._before
            front, left = self.LEGS[leg]
            # raising the front-left corner tilts the base backward and to the right, where gravity then points
            self.failed |= bool(-front * change[0] < self.LEAST or -left * change[1] < self.LEAST)
        return target


class BallisticLanding:
    """The landing pose until a paw touches the ground."""

    def __init__(self, dt: float) -> None:
        """Start the flight; dt: time of a tick [s]."""
        self._left = round(FLIGHT_TIME / dt)

    def step(self, down: bool) -> bool:
        """Advance a tick; return whether the flight has ended. down: whether a paw touches the ground."""
        self._left -= 1
        return down or self._left <= 0
