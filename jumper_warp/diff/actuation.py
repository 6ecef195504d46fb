"""Names and rows of what lies between targets and torques in a rollout."""

from __future__ import annotations

import math

import numpy as np

from jumper_warp.robot.motors import FilterCfg, vertical_jump_filter

MOTOR_CONSTANTS = ("kp", "kd", "saturation", "peak", "cutoff_speed", "no_load_speed", "offset")
"""Constants of a motor, units as in `jumper_warp.kernels.actuation.motors`."""
LIMITS = ("lower", "upper", "lower_zone", "upper_zone")
FILTER_NAMES = (*(f"{what}.{limit}" for what in ("lateral", "transversal", "sum") for limit in LIMITS), "horizon",
                "speed_floor")  # fmt: skip
"""Rows of the filter's constants: angles [rad], horizon [s], speed [rad/s]. Zones only switch: their gradient is 0."""


def filter_rows(cfg: FilterCfg | None) -> np.ndarray:
    """Return a filter's constants in the order of `FILTER_NAMES`; without a filter, those of some other one."""
    cfg = cfg or vertical_jump_filter()
    angles = [getattr(getattr(cfg, what), limit) for what in ("lateral", "transversal", "sum") for limit in LIMITS]
    return np.array([*np.radians(angles), cfg.horizon, math.radians(cfg.speed_floor)])
