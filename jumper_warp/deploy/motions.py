"""Motions without a policy: ramps between poses, the test of each leg's sign, and landing after a fault in flight."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from jumper_warp.deploy.skills import Motion

FLIGHT_TIME = 1.0  # [s] Longest flight after a fault; then the motors brake
LEG_TIME = 0.15  # [s] in which the legs reach the landing pose


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
    ANGLE = 0.25  # [rad] of outer and inner joint
    TIMES = (0.25, 0.40, 0.65, 1.0)  # [s] of each leg: extended, measured, back, at rest
    LEAST = 0.004  # least change of gravity's direction [1] toward the opposite corner

    def __init__(self, default: np.ndarray, dt: float) -> None:
        """Start in the default pose (12,) [rad]; dt: time of a tick [s]."""
        self._default = default
        self._dt = dt
        self._ticks = round(self.TIMES[-1] / dt)
        self._tick = 0
        self._before = np.zeros(3)
        self.failed = False

    @property
    def done(self) -> bool:
        """Whether all legs have been tested."""
        return self._tick >= 4 * self._ticks

    def step(self, motion: Motion) -> np.ndarray:
        """Advance a tick and return the targets [rad], (12,)."""
        target = self._default.copy()
        if self.done:
            return target
        leg, tick = divmod(self._tick, self._ticks)
        self._tick += 1
        if tick == 0:
            self._before = motion.gravity
        fraction = np.interp(tick * self._dt, (0.0, *self.TIMES), (0.0, 1.0, 1.0, 0.0, 0.0))
        target[3 * leg + 1 : 3 * leg + 3] -= np.float32(self.ANGLE * fraction)
        if tick == round(self.TIMES[1] / self._dt):
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
        self._moving = round(LEG_TIME / dt)

    def step(self, down: bool, blind: bool) -> bool:
        """Advance a tick; return whether the flight has ended.

        down: whether a paw touches the ground. blind: whether that follows from torques alone, which also move the
        legs at first.
        """
        self._left -= 1
        self._moving -= 1
        return (bool(down) and not (blind and self._moving > 0)) or self._left <= 0
