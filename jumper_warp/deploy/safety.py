"""Faults of the machine: how each is detected, and after how many ticks the robot leaves its policy.

A fault of ACTING ends the policy in its first tick. With any other one the motors keep their last target for up to
HOLD_TICKS ticks; in the next tick the policy ends.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from enum import IntEnum
from typing import Any

import numpy as np

FEW_ERRORS = 3  # Error frames of a tick that are no fault; nor is one lost frame of a motor or of the IMU
some = np.count_nonzero  # whether one of an array is true: faster than np.any
HOLD_TICKS = 4  # Ticks with a fault through which the motors keep their last target


Fault = IntEnum("Fault", (
    "NONE", "SILENT", "BUS_OFF", "ERROR_FRAME", "WRONG_ID", "MOTOR_ERROR", "TEMPERATURE", "TORQUE", "SPEED", "POSITION",
    "TILT", "STALE", "DIVERGED", "NOT_FINITE", "LATE", "STOP", "SIGN", "MOVING",
), start=0)  # fmt: skip
"""Faults that end a policy. SILENT: a motor does not reply; BUS_OFF: a bus cannot send; ERROR_FRAME: many of them in a
tick; WRONG_ID: a frame of another id scheme; TORQUE: a motor exceeds its torque limit and the torque of its command;
STALE: the IMU sends nothing new; DIVERGED: the state is unknown; NOT_FINITE: action or observation of the policy; STOP:
of the operator; SIGN: a joint or a leg does not move as it should; MOVING: not at rest for 0.2 s before the
operator enables the motors."""
ACTING = {Fault[name] for name in "WRONG_ID MOTOR_ERROR TEMPERATURE SPEED POSITION TILT STOP SIGN".split()}
"""Faults that end the policy at once."""


class Safety:
    """Checks of every tick."""

    def __init__(self, settings: Mapping[str, Any], transversal_sum: Sequence[float]) -> None:
        """Read the section safety of deploy.yaml; transversal_sum: limits of outer + inner angle [deg].

        Raises LookupError, TypeError or ValueError: a limit is missing, or of another type or size.
        """
        names = ("torque_factor", "torque_margin", "max_temperature", "max_rate", "max_tilt", "max_late")
        self._limits = {name: float(settings[name]) for name in names}
        margin, (low, high) = np.radians(settings["position_margin"]), transversal_sum
        self._lower = np.radians([*settings["lower"], *4 * [low]]) - margin  # (16,) [rad] of joints, and of legs' sums
        self._upper = np.radians([*settings["upper"], *4 * [high]]) + margin
        if self._lower.shape != (16,) or self._upper.shape != (16,):
            raise ValueError("lower and upper of the section safety need 12 angles each")
        self._ages = np.zeros(13, int)  # ticks since the last frame of each motor and of the IMU
        self.fault = Fault.NONE
        self.ticks = 0  # for how long it has lasted

    def check(
        self, received: np.ndarray, q: np.ndarray, qd: np.ndarray, torque: np.ndarray, limit: np.ndarray,
        temperature: np.ndarray, error: np.ndarray, *, tilt: float, stale: bool, diverged: bool, finite: bool,
        late: float, stop: bool, sign: bool,
    ) -> bool:  # fmt: skip
        """Update `fault` and `ticks`, and return whether the policy must end.

        received: record of the tick's frames. q, qd, torque, limit: (12,) [rad], [rad/s], [N m]. temperature [°C],
        error: (12,). tilt: angle from upright [rad], 0 in flight. late: delay of the tick [s]. sign: whether a test of
        signs has failed.
        """
        limits = self._limits
        self._ages += 1
        self._ages[:12][received["motor_fresh"]] = 0
        self._ages[12] *= stale
        angles = np.concatenate([q, q[1::3] + q[2::3]])
        found = (
            (Fault.STOP, stop),
            (Fault.WRONG_ID, received["unknown"] > 0),
            (Fault.MOTOR_ERROR, some(error)),
            (Fault.TEMPERATURE, some(temperature > limits["max_temperature"])),
            (Fault.SPEED, some(np.abs(qd) > limits["max_rate"])),
            (Fault.POSITION, some((angles < self._lower) | (angles > self._upper))),
            (Fault.TILT, tilt > np.radians(limits["max_tilt"])),
            (Fault.BUS_OFF, some(received["bus_off"])),
            (Fault.ERROR_FRAME, received["error_frames"] > FEW_ERRORS),
            (Fault.SILENT, self._ages[:12].max() > 1),
            (Fault.SIGN, sign),
            (Fault.TORQUE, some(np.abs(torque) > limits["torque_factor"] * limit + limits["torque_margin"])),
            (Fault.STALE, self._ages[12] > 1),
            (Fault.DIVERGED, diverged),
            (Fault.NOT_FINITE, not finite),
            (Fault.LATE, late > limits["max_late"]),
        )
        self.fault = next((fault for fault, present in found if present), Fault.NONE)
        self.ticks = max(self.ticks + 1, int(self._ages.max())) if self.fault else 0
        gone = late > (HOLD_TICKS + 1) * limits["max_late"] * 2.0
        return self.fault in ACTING or self.ticks > HOLD_TICKS or gone
