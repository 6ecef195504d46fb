"""Motor control of a tick in float32: position control, the torque-speed curve, and targets within a torque limit.

`motor_torque` computes the same bits as the simulation's motors (`kernels/actuation/motors.py`) on a CPU. Arrays have
one value per joint, (12,).
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np


class Gains(NamedTuple):
    """Gains and torque limits of a skill's joints, (12,) float32."""

    kp: np.ndarray  # [N m/rad]
    kd: np.ndarray  # [N m s/rad]
    limit: np.ndarray  # [N m]

    @classmethod
    def from_yaml(cls, fields: Mapping[str, Any]) -> Gains:
        """Return the gains in the keys stiffness, damping and torque_limit of a section of deploy.yaml."""
        return cls(*(np.array(fields[name], dtype=np.float32) for name in ("stiffness", "damping", "torque_limit")))


class TorqueCurve(NamedTuple):
    """Largest torques of the joints' motors by speed, (12,) float32 each."""

    peak: np.ndarray  # [N m]
    cutoff_speed: np.ndarray  # [rad/s] full driving torque up to here
    no_load_speed: np.ndarray  # [rad/s] no driving torque from here
    fade_start: np.ndarray  # [rad/s] over-speed protection reduces the torque from here
    fade_end: np.ndarray  # [rad/s] no torque from here


ONE, NONE = np.float32(1.0), np.float32(0.0)


def motor_torque(
    target: np.ndarray, angle: np.ndarray, rate: np.ndarray, gains: Gains, curve: TorqueCurve
) -> np.ndarray:
    """Return the joints' torques [N m] under position control; target, angle [rad], rate [rad/s] float32.

    It is bounded by the torque limit and the torque-speed curve; over-speed protection then fades it.
    """
    command = gains.kp * (target - angle) - gains.kd * rate
    width = curve.no_load_speed - curve.cutoff_speed

    def envelope(direction: np.float32) -> np.ndarray:
        """Return the largest torque [N m] along a direction, 1 or -1."""
        headroom = np.minimum(np.maximum((curve.no_load_speed - direction * rate) / width, NONE), ONE)
        return np.minimum(gains.limit, curve.peak * headroom)

    bounded = np.minimum(np.maximum(command, -envelope(-ONE)), envelope(ONE))
    fade = (curve.fade_end - np.abs(rate)) / (curve.fade_end - curve.fade_start)
    return bounded * np.minimum(np.maximum(fade, NONE), ONE)


def clip_target(target: np.ndarray, angle: np.ndarray, rate: np.ndarray, gains: Gains) -> np.ndarray:
    """Return the targets [rad] nearest to `target` for which no motor is asked for more than its torque limit.

    MIT frames carry no torque limit: the motor computes kp · (target − angle) − kd · rate. target, angle [rad], rate
    [rad/s]: float32.
    """
    damping = gains.kd * rate
    lowest, highest = angle + (damping - gains.limit) / gains.kp, angle + (damping + gains.limit) / gains.kp
    return np.minimum(np.maximum(target, lowest), highest)
