"""Motions without a policy: ramps between poses, the test of each leg's sign, and landing after a fault in flight."""

from __future__ import annotations

from collections.abc import Callable, Sequence

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


LEGS = ((1.0, 1.0), (1.0, -1.0), (-1.0, 1.0), (-1.0, -1.0))  # front, left of FL, FR, BL, BR
LEAST = 0.004  # least change of gravity's direction [1] toward the opposite corner


class MotionTest:
    """Moves parts of a robot in the default pose and back, one after the other, and compares the response."""

    def __init__(
        self, default: np.ndarray, dt: float, offsets: np.ndarray, fails: Callable[[int, np.ndarray, np.ndarray], bool]
    ) -> None:
        """Start in the default pose (12,) [rad]; dt: time of a tick [s]; offsets: motions (parts, 12) [rad].

        fails: whether the response of a part is wrong: of the joints (12,) [rad], of gravity in the body (3,).
        """
        self._default, self._dt, self._offsets, self._fails = default, dt, np.asarray(offsets, np.float32), fails
        self._ticks = round(TEST_TIMES[-1] / dt)
        self._tick = 0
        self.failed = False

    @property
    def done(self) -> bool:
        """Whether all parts have been tested."""
        return self._tick >= len(self._offsets) * self._ticks

    def step(self, motion: Motion) -> np.ndarray:
        """Advance a tick and return the targets [rad], (12,)."""
        if self.done:
            return self._default
        part, tick = divmod(self._tick, self._ticks)
        self._tick += 1
        if tick == 0:
            self._q, self._gravity = motion.q, motion.gravity
        if tick == round(TEST_TIMES[1] / self._dt):
            self.failed |= bool(self._fails(part, motion.q - self._q, motion.gravity - self._gravity))
        fraction = np.interp(tick * self._dt, (0.0, *TEST_TIMES), (0.0, 1.0, 1.0, 0.0, 0.0))
        return self._default + np.float32(fraction) * self._offsets[part]


def sign_test(default: np.ndarray, dt: float) -> MotionTest:
    """Extend one leg after the other of a standing robot: the base must tilt away from it, else cables are swapped."""

    def fails(leg: int, moved: np.ndarray, change: np.ndarray) -> bool:
        """Return whether gravity does not turn: a raised front-left corner tilts the base backward and to the right.

        moved: unused. change: of the unit vector of gravity (3,), body axes.
        """
        front, left = LEGS[leg]
        return -front * change[0] < LEAST or -left * change[1] < LEAST

    return MotionTest(default, dt, -0.25 * np.kron(np.eye(4), [0.0, 1.0, 1.0]), fails)


def joint_test(default: np.ndarray, joint: int, dt: float) -> MotionTest:
    """Move one joint of a robot on a stand: it alone must follow, in the direction that the operator expects."""
    offset = 0.15 * np.eye(12)[joint]  # [rad]

    def fails(part: int, moved: np.ndarray, change: np.ndarray) -> bool:
        """Return whether a joint's motion differs from its command by half the angle."""
        return bool((np.abs(moved - offset) > 0.5 * offset.max()).any())

    return MotionTest(default, dt, offset[None], fails)


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
