"""Metrics of jumps to heights and to landing positions."""

from __future__ import annotations

import numpy as np

from jumper_warp.evaluation.jumps import JumpOutcome
from jumper_warp.utils.metrics import Metric, Metrics, chosen, largest, mean, measure, rate

LEVEL_TILT = 10.0  # [deg] Tilt of the base below which a landing is level
DRIFT, TURN = 0.2, 25.0  # [m], [deg] Drift and turn of the base beyond which the authors' configuration ends an episode

SUCCESS_METRICS = (
    Metric("success_rate", rate, "jumps", lambda o: o.success),
    Metric("goal_reached_rate", rate, "jumps", lambda o: o.reached),
    Metric("landed_rate", rate, "jumps", lambda o: o.landed),
    Metric("at_rest_rate", rate, "jumps", lambda o: o.at_rest),
    Metric("no_paw_lift_rate", rate, "jumps", lambda o: o.still),
    Metric("success_without_paw_lift_rate", rate, "jumps", lambda o: o.success & o.still),
    Metric("success_without_hop_rate", rate, "jumps", lambda o: o.success & ~o.hopped),
)
"""Table of the rates of successful jumps and of the parts of a success; `JumpOutcome` defines their events."""
FAILURE_METRICS = (
    Metric("fall_rate", rate, "jumps", lambda o: o.fell),
    Metric("collision_rate", rate, "jumps", lambda o: o.collided),
    Metric("diverged_rate", rate, "jumps", lambda o: o.diverged),
    Metric("miss_rate", rate, "jumps", lambda o: o.missed),
    Metric("early_rate", rate, "jumps", lambda o: o.early),
    Metric("no_jump_rate", rate, "jumps", lambda o: o.no_jump),
    Metric("second_takeoff_rate", rate, "jumps that touched down", lambda o: o.took_off_again),
    Metric("landing_tilt_below_10_deg_rate", rate, "landed jumps", lambda o: o.tilt_deg < LEVEL_TILT),
    Metric("landing_tilt_mean_deg", mean, "landed jumps", lambda o: o.tilt_deg),
    Metric("landing_tilt_max_deg", largest, "landed jumps", lambda o: o.tilt_deg),
    Metric("turn_abs_mean_deg", mean, "landed jumps", lambda o: o.turn_deg),
    Metric("turn_abs_max_deg", largest, "landed jumps", lambda o: o.turn_deg),
)
"""Table of the rates of failures, and of tilt and turn after the landing."""
HEIGHT_METRICS = (
    *SUCCESS_METRICS,
    Metric("apex_error_abs_mean_m", mean, "jumps that did not diverge", lambda o: np.abs(o.apex_error_m)),
    Metric("apex_error_signed_mean_m", mean, "jumps that did not diverge", lambda o: o.apex_error_m),
    Metric("apex_error_abs_max_of_successes_m", largest, "successful jumps", lambda o: np.abs(o.apex_error_m)),
    Metric("apex_max_m", largest, "jumps that did not diverge", lambda o: o.apex_m),
    Metric("drift_mean_m", mean, "landed jumps", lambda o: o.drift_m),
    Metric("drift_max_m", largest, "landed jumps", lambda o: o.drift_m),
    Metric("beyond_authors_limits_rate", rate, "landed jumps", lambda o: (o.drift_m > DRIFT) | (o.turn_deg > TURN)),
    *FAILURE_METRICS,
)
"""Table of the metrics of jumps to heights; the authors' limits on drift and turn are DRIFT and TURN."""
PLACE_METRICS = (
    *SUCCESS_METRICS,
    Metric("goal_distance_at_rest_mean_m", mean, "landed jumps", lambda o: o.distance_at_rest_m),
    Metric("goal_distance_at_touchdown_mean_m", mean, "jumps that touched down", lambda o: o.distance_at_touchdown_m),
    Metric("goal_distance_at_end_mean_m", mean, "jumps that did not diverge", lambda o: o.distance_at_end_m),
    Metric("goal_distance_at_rest_max_m", largest, "landed jumps", lambda o: o.distance_at_rest_m),
    Metric("goal_error_ahead_signed_mean_m", mean, "landed jumps", lambda o: o.ahead_m),
    Metric("goal_error_left_signed_mean_m", mean, "landed jumps", lambda o: o.left_m),
    Metric("distance_flown_mean_m", mean, "jumps that touched down", lambda o: o.distance_flown_m),
    Metric("paw_to_paw_distance_mean_m", mean, "landed jumps", lambda o: o.paw_to_paw_distance_m),
    *FAILURE_METRICS,
)
"""Table of the metrics of jumps to landing positions."""
IN_RANGE = ("success_rate", "goal_reached_rate", "no_paw_lift_rate", "apex_error_abs_mean_m",
            "goal_distance_at_rest_mean_m")  # fmt: skip
"""Keys of metrics that are also reported for goals within a range, with the prefix `in_range_`."""


def jump_metrics(outcome: JumpOutcome, where: np.ndarray | None = None, prefix: str = "", note: str = "") -> Metrics:
    """Return success rates, errors and failures of jumps to heights or to landing positions.

    These are HEIGHT_METRICS or PLACE_METRICS; arguments: see `measure`.
    """
    table = HEIGHT_METRICS if outcome.to_height.all() else PLACE_METRICS
    return measure(table, outcome, where, prefix, note)


def range_metrics(outcome: JumpOutcome, inside: np.ndarray, note: str) -> Metrics:
    """Return success rates and mean errors of the jumps with goals within a range, as `in_range_<key>`.

    Keys: IN_RANGE; inside: mask of these jumps; note: description of the range.
    """
    table = HEIGHT_METRICS if outcome.to_height.all() else PLACE_METRICS
    return measure(chosen(table, *IN_RANGE), outcome, inside, "in_range_", note)
