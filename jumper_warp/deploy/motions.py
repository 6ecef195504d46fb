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


TEST_TIMES = (0.25, 0.40, 0.65, 1.0)  # [s] of each motion of a test: moved, measured, back, at rest


class _Test:
    """Moves joints of a robot in the default pose and back, one part after the other, and compares the response."""

    parts = 1

    def __init__(self, default: np.ndarray, dt: float) -> None:
        """Start in the default pose (12,) [rad]; dt: time of a tick [s]."""
        self._default = default
        self._dt = dt
        self._ticks = round(TEST_TIMES[-1] / dt)
        self._tick = 0
        self.failed = False

    @property
    def done(self) -> bool:
        """Whether all parts have been tested."""
        return self._tick >= self.parts * self._ticks

    def step(self, motion: Motion) -> np.ndarray:
        """Advance a tick and return the targets [rad], (12,)."""
        target = self._default.copy()
        if self.done:
            return target
        part, tick = divmod(self._tick, self._ticks)
        self._tick += 1
        if tick == 0:
            self._q, self._gravity = motion.q, motion.gravity
        if tick == round(TEST_TIMES[1] / self._dt):
            self.failed |= bool(self.fails(part, motion.q - self._q, motion.gravity - self._gravity))
        fraction = np.interp(tick * self._dt, (0.0, *TEST_TIMES), (0.0, 1.0, 1.0, 0.0, 0.0))
        return target + np.float32(fraction) * self.offset(part)

    def offset(self, part: int) -> np.ndarray:
        """Return the motion of the joints [rad], (12,)."""
        raise NotImplementedError

    def fails(self, part: int, moved: np.ndarray, change: np.ndarray) -> bool:
        """Return whether the response is wrong: of the joints (12,) [rad], of gravity's direction in the body (3,)."""
        raise NotImplementedError


class SignTest(_Test):
    """Extend one leg after the other of a standing robot: the base must tilt away from it, else cables are swapped."""

    parts = 4
    LEGS = ((1.0, 1.0), (1.0, -1.0), (-1.0, 1.0), (-1.0, -1.0))  # front, left of FL, FR, BL, BR
    ANGLE = 0.25  # [rad] of outer and inner joint
    LEAST = 0.004  # least change of gravity's direction [1] toward the opposite corner

    def offset(self, part: int) -> np.ndarray:
        """Return the extension of a leg."""
        return np.float32(-self.ANGLE) * np.isin(np.arange(12), (3 * part + 1, 3 * part + 2))

    def fails(self, part: int, moved: np.ndarray, change: np.ndarray) -> bool:
        """Return whether gravity does not turn: a raised front-left corner tilts the base backward and to the right."""
        front, left = self.LEGS[part]
        return -front * change[0] < self.LEAST or -left * change[1] < self.LEAST


class JointTest(_Test):
    """Move one joint of a robot on a stand: it alone must follow, in the direction that the operator expects."""

    ANGLE = 0.15  # [rad]

    def __init__(self, default: np.ndarray, joint: int, dt: float) -> None:
        """Start in the default pose (12,) [rad]; joint: number; dt: time of a tick [s]."""
        super().__init__(default, dt)
        self._moves = np.arange(12) == joint

    def offset(self, part: int) -> np.ndarray:
        """Return the motion of the joint."""
        return np.float32(self.ANGLE) * self._moves

    def fails(self, part: int, moved: np.ndarray, change: np.ndarray) -> bool:
        """Return whether the joint moves less than half the angle, or another one more."""
        return bool((moved[self._moves] < 0.5 * self.ANGLE).any() or (moved[~self._moves] > 0.5 * self.ANGLE).any())


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
