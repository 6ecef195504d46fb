"""Evaluation of jumps to heights and to landing positions: metrics, and flags of `jumper evaluate` and `play`."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
import tyro

from jumper_warp.evaluation.jumps import DELAY, REST_TIME, TOLERANCE, JumpLog, JumpOutcome, random_headings
from jumper_warp.evaluation.log import check, within
from jumper_warp.tasks.cfg import TaskCfg
from jumper_warp.tasks.jump.evaluation import HeightEvaluation, PlaceEvaluation
from jumper_warp.utils.checks import check_finite
from jumper_warp.utils.metrics import Metric, Metrics, chosen, largest, mean, measure, rate

Position2D = tuple[float, float]  # [m] Ahead and to the left
MAX_ROBOTS = 64  # Maximum number of robots in one recording
JUMP_SECONDS, NEXT_JUMP_SECONDS = 3.5, 2.5  # [s] Length of a recording of one jump, and addition for each further jump
LEVEL_TILT = 10.0  # [deg] Tilt of the base below which a landing is level
DRIFT, TURN = 0.2, 25.0  # [m], [deg] Drift and turn of the base beyond which the authors' configuration ends an episode


def within_limits(outcome: JumpOutcome) -> np.ndarray:
    """Return whether the base ends within the authors' limits on drift and turn, bool, shaped as the fields."""
    return (outcome.drift_m <= DRIFT) & (outcome.turn_deg <= TURN)


SUCCESS_METRICS = (
    Metric("success_rate", rate, "jumps", lambda o: o.success),
    Metric("goal_reached_rate", rate, "jumps", lambda o: o.reached),
    Metric("landed_rate", rate, "jumps", lambda o: o.landed),
    Metric("at_rest_rate", rate, "jumps", lambda o: o.at_rest),
    Metric("no_paw_lift_rate", rate, "jumps", lambda o: o.still),
    Metric("success_without_paw_lift_rate", rate, "jumps", lambda o: o.success & o.still),
    Metric("success_without_hop_rate", rate, "jumps", lambda o: o.success & ~o.hopped),
    Metric("stance_height_mean_m", mean, "jumps", lambda o: o.stance_m),
    Metric("squat_height_mean_m", mean, "jumps", lambda o: o.squat_m),
    Metric("height_at_end_mean_m", mean, "landed jumps", lambda o: o.height_at_end_m),
    Metric("transversal_angle_max_deg", largest, "jumps that did not diverge", lambda o: o.transversal_deg),
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
    Metric("beyond_authors_limits_rate", rate, "landed jumps", lambda o: ~within_limits(o)),
    Metric("success_within_authors_limits_rate", rate, "jumps", lambda o: o.success & within_limits(o)),
    *FAILURE_METRICS,
)
"""Table of the metrics of jumps to heights; the authors' limits on drift and turn are DRIFT and TURN."""
PLACE_METRICS = (
    *SUCCESS_METRICS,
    Metric("success_at_touchdown_rate", rate, "jumps", lambda o: o.success & (o.distance_at_touchdown_m <= TOLERANCE)),
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


def jump_metrics(outcome: JumpOutcome, prefix: str = "", note: str = "") -> Metrics:
    """Return success rates, errors and failures of jumps to heights or to landing positions.

    These are HEIGHT_METRICS or PLACE_METRICS; arguments: see `measure`.
    """
    return measure(HEIGHT_METRICS if outcome.to_height.all() else PLACE_METRICS, outcome, None, prefix, note)


def range_metrics(outcome: JumpOutcome, inside: np.ndarray, note: str) -> Metrics:
    """Return success rates and mean errors of those jumps whose goals are within a range, as `in_range_<key>`.

    Keys: IN_RANGE; inside: mask of these jumps; note: description of the range.
    """
    table = HEIGHT_METRICS if outcome.to_height.all() else PLACE_METRICS
    return measure(chosen(table, *IN_RANGE), outcome, inside, "in_range_", note)


@dataclass(frozen=True)
class JumpFlags:
    """Flags of `jumper evaluate` for jumps from rest in the default pose."""

    num_jumps: int = 200  # Number of jumps
    success_range: tuple[float, float] = field(default=PlaceEvaluation.success_range, kw_only=True)
    """[m] Smallest and largest distance or height counted by the `in_range` metrics."""
    hold: float = field(default=REST_TIME, kw_only=True)
    """[s] Time after touchdown until which nothing but the paws may touch anything."""

    def __post_init__(self) -> None:
        """Raise InputError for no jumps, a range of successful goals that does not rise, or a time out of range."""
        check(REST_TIME <= self.hold <= 60.0, f"hold must be in [{REST_TIME:g}, 60] s, got {self.hold}")
        check(self.num_jumps >= 1, f"num_jumps must be at least 1, got {self.num_jumps}")
        low, high = self.success_range
        check(0.0 <= low <= high < 10.0, f"success_range must be in [0, 10) m and rise, got {self.success_range}")

    def metrics(self, log: JumpLog) -> Metrics:
        """Return the metrics of a finished log of jumps: of all, and of those with goals within `success_range`."""
        (low, high), outcome = self.success_range, log.outcome
        size = np.linalg.norm(log.goals, axis=-1)  # [m] height or distance; the other is 0
        inside = within(size, self.success_range)
        return jump_metrics(outcome) | range_metrics(outcome, inside, f"with goals of {low:g} to {high:g} m")


@dataclass(frozen=True)
class HeightFlags(JumpFlags):
    """Flags of `jumper evaluate` for jumps to evenly spaced heights."""

    success_range: tuple[float, float] = field(default=HeightEvaluation.success_range, kw_only=True)
    height_range: tuple[float, float] = HeightEvaluation.height_range  # [m] Lowest and highest commanded base height

    def __post_init__(self) -> None:
        """Raise InputError for heights [m] out of range, and as `JumpFlags`."""
        super().__post_init__()
        low, high = self.height_range
        check(0.0 < low <= high < 10.0, f"height_range must be in (0, 10) m and rise, got {self.height_range}")

    def log(self, task: TaskCfg, seed: int) -> JumpLog:
        """Return a new log of one jump per world to evenly spaced heights; seed has no effect."""
        return JumpLog(np.linspace(*self.height_range, self.num_jumps), task.termination_names, rest=self.hold)


@dataclass(frozen=True)
class HeightPlayFlags:
    """Flags of `jumper play` for jumps to heights."""

    height: tuple[float, ...] = HeightEvaluation.height  # [m] Commanded base heights, one robot each
    length: tyro.conf.Suppress[float] = HeightEvaluation.length
    """[s] Length of the recording, unless `jumper play --seconds` sets it."""

    def __post_init__(self) -> None:
        """Raise InputError for a height [m] out of range, or more robots than a film shows."""
        fits = 1 <= len(self.height) <= MAX_ROBOTS and all(0.0 < height < 10.0 for height in self.height)
        check(fits, f"height takes 1 to {MAX_ROBOTS} numbers in (0, 10) m, got {self.height}")

    def log(self, task: TaskCfg) -> JumpLog:
        """Return a new log of one jump per robot to the flags' heights."""
        return JumpLog(np.array(self.height), task.termination_names)


@dataclass(frozen=True)
class LandingFlags(JumpFlags):
    """Flags of `jumper evaluate` for jumps to landing positions from rest in the default pose."""

    goal_x: tuple[float, float] = PlaceEvaluation.goal_x
    """[m] Smallest and largest distance of the goal ahead; goals are evenly spaced."""
    goal_y: tuple[float, float] = PlaceEvaluation.goal_y
    """[m] Smallest and largest distance of the goal to the left; goals are sampled."""
    heading: Literal["any"] | float = "any"  # [deg] Heading of all robots, or any: sampled from the full circle
    delay: float = DELAY  # [s] Time until the jump is commanded; 0 for policies that always observe their goal

    def __post_init__(self) -> None:
        """Raise InputError for goals [m] out of range or a heading that is not finite, and as `JumpFlags`."""
        super().__post_init__()
        for name in ("goal_x", "goal_y"):
            low, high = getattr(self, name)
            check(-10.0 < low <= high < 10.0, f"{name} must be in (-10, 10) m and rise, got {low}, {high}")
        check(0.0 <= self.delay <= 10.0, f"delay must be in [0, 10] s, got {self.delay}")
        if self.heading != "any":
            check_finite("heading", self.heading)

    def log(self, task: TaskCfg, seed: int) -> JumpLog:
        """Return a new log of one jump per world, with goals and headings from the flags."""
        rng = np.random.default_rng((seed, 1))  # headings have the seed itself
        goals = np.stack([np.linspace(*self.goal_x, self.num_jumps), rng.uniform(*self.goal_y, self.num_jumps)], axis=1)
        headings = random_headings(self.num_jumps, seed) if self.heading == "any" else math.radians(self.heading)
        return JumpLog(goals[:, None], task.termination_names, headings, self.delay, self.hold)


@dataclass(frozen=True)
class LandingPlayFlags:
    """Flags of `jumper play` for jumps to landing positions."""

    goal: tyro.conf.UseAppendAction[tuple[Position2D, ...]] = ()
    """[m] Goal of a robot, ahead and to the left; repeat the flag for each robot (default: three goals)."""
    next_goals: tyro.conf.UseAppendAction[tuple[Position2D, ...]] = ()
    """[m] Goal of all robots' next jump, ahead and to the left, a second after touchdown; repeat it for each jump."""
    default_goals: tyro.conf.Suppress[tuple[Position2D, ...]] = PlaceEvaluation.default_goals
    """[m] Goals if `goal` is not passed; a default of `goal` itself would be kept when the flag is passed."""

    def __post_init__(self) -> None:
        """Raise InputError for a goal [m] out of range, or more robots than a film shows."""
        for name in ("goal", "next_goals"):
            places = getattr(self, name)
            fits = len(places) <= MAX_ROBOTS and all(-10.0 < value < 10.0 for place in places for value in place)
            check(fits, f"{name} takes up to {MAX_ROBOTS} positions in (-10, 10) m, got {places}")

    @property
    def goals(self) -> tuple[Position2D, ...]:
        """First goal of each robot [m], ahead of it and to its left."""
        return self.goal or self.default_goals

    @property
    def length(self) -> float:
        """Length of the recording [s]."""
        return JUMP_SECONDS + NEXT_JUMP_SECONDS * len(self.next_goals)

    def log(self, task: TaskCfg) -> JumpLog:
        """Return a new log of the jumps: each robot jumps to its entry of `goals`, then to all `next_goals`."""
        return JumpLog(np.array([[goal, *self.next_goals] for goal in self.goals]), task.termination_names)
