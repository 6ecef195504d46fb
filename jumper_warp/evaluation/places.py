"""Jumps to places: what is asked for, and the metrics of what became of it."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import tyro

from jumper_warp.evaluation.heights import MAX_ROBOTS, HeightGoals, check_jumps
from jumper_warp.evaluation.jumps import REST_SPEED, REST_TIME
from jumper_warp.evaluation.landings import FALLS, MISSED, NOT_BEGUN, Landings
from jumper_warp.evaluation.log import (
    CAME_APART,
    COLLIDED,
    Metrics,
    failures,
    largest,
    mean,
    termination_names,
    within,
)
from jumper_warp.tasks.cfg import TaskCfg
from jumper_warp.utils.errors import InputError

Place = tuple[float, float]
AT_END = "below_0_1_m_s_at_the_end_rate"
"""Name of the share of landed jumps whose base was at rest (`REST_SPEED`) when the jump was over."""
SECONDS_MORE = 2.5
"""[s] Of a recording for each further jump."""


@dataclass(frozen=True)
class PlaceFlags:
    """Jumps to places from standing still."""

    jumps: int = 200
    """Number of jumps."""
    x: Place = (0.3, 1.5)
    """[m] Goals ahead, evenly spaced between these."""
    y: Place = (0.0, 0.0)
    """[m] Goals to the left, drawn between these."""
    heading: Literal["any"] | float = "any"
    """[deg] Heading of all robots, or any: drawn from the full circle."""
    in_range: Place = (0.3, 1.4)
    """[m] Distances that the success rate in range counts."""

    def __post_init__(self) -> None:
        """Raises InputError: a setting is out of range."""
        check_jumps(self.jumps, self.in_range)
        for name in ("x", "y"):
            low, high = getattr(self, name)
            if not -10.0 < low <= high < 10.0:
                raise InputError(f"{name} must be in (-10, 10) m and rise, got {low}, {high}")
        if self.heading != "any" and not math.isfinite(self.heading):
            raise InputError(f"heading must be finite or any, got {self.heading}")

    @property
    def count(self) -> int:
        """Number of worlds."""
        return self.jumps

    def log(self, task: TaskCfg, seed: int) -> Landings:
        """Return single jumps with these goals and headings."""
        rng = np.random.default_rng(seed)
        goals = np.stack([np.linspace(*self.x, self.jumps), rng.uniform(*self.y, self.jumps)], axis=1)
        headings = random_headings(self.jumps, seed) if self.heading == "any" else math.radians(self.heading)
        return Landings(goals[:, None], termination_names(task), headings)

    def metrics(self, log: Landings) -> Metrics:
        """Return `landing_metrics`, with the range."""
        inside = within(np.linalg.norm(log.goals, axis=-1), self.in_range)
        return landing_metrics(log, inside) | {"range_lower_m": self.in_range[0], "range_upper_m": self.in_range[1]}


@dataclass(frozen=True)
class PlaceGoals:
    """Jumps to places that are recorded."""

    goal: tyro.conf.UseAppendAction[tuple[Place, ...]] = ()
    """[m] Where to land, ahead and to the left; once for each robot (default: three robots, each to another place)."""
    then: tyro.conf.UseAppendAction[tuple[Place, ...]] = ()
    """[m] Where all robots jump next, a second after touchdown, from where they are by then; once for each jump."""
    unless_told: tyro.conf.Suppress[tuple[Place, ...]] = ((0.5, 0.0), (0.9, 0.0), (1.3, 0.0))
    """[m] Goals if there are none; flags that are given several times would be added to a default."""

    spacing = 2.0

    def __post_init__(self) -> None:
        """Raises InputError: a place is out of range, or their number."""
        for name in ("goal", "then"):
            places = getattr(self, name)
            if len(places) > MAX_ROBOTS or not all(-10.0 < value < 10.0 for place in places for value in place):
                raise InputError(f"{name} takes up to {MAX_ROBOTS} places in (-10, 10) m, got {places}")

    @property
    def goals(self) -> tuple[Place, ...]:
        """[m] First goals, one a robot."""
        return self.goal or self.unless_told

    @property
    def count(self) -> int:
        """Number of worlds."""
        return len(self.goals)

    @property
    def seconds(self) -> float:
        """[s] Length of the recording."""
        return HeightGoals.seconds + SECONDS_MORE * len(self.then)

    @property
    def notes(self) -> dict[str, Any]:
        """What to save with the recording."""
        return {"goals_m": self.goals, "then_m": self.then}

    def log(self, task: TaskCfg) -> Landings:
        """Return one row of jumps a robot."""
        return Landings(np.array([[goal, *self.then] for goal in self.goals]), termination_names(task))


def random_headings(count: int, seed: int) -> np.ndarray:
    """Return headings (count,) [rad] over the full circle."""
    return np.random.default_rng(seed).uniform(-math.pi, math.pi, count)


def landing_metrics(landings: Landings, inside: np.ndarray | None = None) -> Metrics:
    """Return the metrics of jumps to places, all rows together.

    Errors are over all jumps, failed ones included, but those whose simulation came apart, which `came_apart` counts,
    and those that were not begun. `ahead` and `left` are signed. Tilts, turns, hops and steps are those of the landed
    jumps. `still_landing_rate` is of all jumps, `second_takeoff_rate` of those that came down. `fall_rate` and
    `miss_rate` share no jump: one that misses has landed on its paws, but elsewhere.

    inside: which jumps the metrics in range count, shaped like `landings.end`; without it there are none.
    """
    begun = landings.ends != NOT_BEGUN
    error, success, landed = landings.error, landings.success, landings.landed
    offset = np.where(np.isnan(error)[..., None], np.nan, landings.offset)
    tilt, yaw = np.degrees(landings.tilt), np.degrees(landings.yaw)
    at_rest = "at_rest_within_1_s_rate" if landings.rest == REST_TIME else AT_END
    metrics: Metrics = {
        "jumps": int(begun.sum()),
        "mean_error_m": mean(error),
        "mean_error_of_successes_m": mean(error[success]),
        "max_error_of_successes_m": largest(error[success]),
        "max_error_m": largest(error),
        "mean_error_ahead_m": mean(offset[..., 0]),
        "mean_error_left_m": mean(offset[..., 1]),
        "success_rate": mean(success[begun]),
        "single_jump_success_rate": mean(landings.single[begun]),
        "step_free_success_rate": mean(landings.step_free[begun]),
        "landing_rate": mean(landed[begun]),
        "second_hop_rate": mean(landings.hopped[landed]),
        "step_rate": mean(landings.stepped[landed]),
        "mean_error_at_touchdown_m": mean(landings.touchdown_error[landed]),
        "mean_error_0_3_s_after_touchdown_m": mean(landings.error_soon[landed]),
        "still_landing_rate": mean(landings.still[begun]),
        "second_takeoff_rate": mean(landings.took_off_again[landings.touched_down]),
        at_rest: mean((landings.rest_speed < REST_SPEED)[landed]),
        "mean_landing_tilt_deg": mean(tilt[landed]),
        "max_landing_tilt_deg": largest(tilt[landed]),
        "mean_turn_deg": mean(np.abs(yaw[landed])),
        "max_turn_deg": largest(np.abs(yaw[landed])),
        "collision_rate": mean((landings.ends == COLLIDED)[begun]),
        "fall_rate": mean(np.isin(landings.ends, FALLS)[begun]),
        "miss_rate": mean((landings.outcomes == MISSED)[begun]),
        "early_rate": mean(landings.early[begun]),
        CAME_APART: int((landings.ends == CAME_APART).sum()),
    }
    if inside is not None:
        inside = begun & inside
        metrics |= {
            "mean_error_in_range_m": mean(error[inside]),
            "success_rate_in_range": mean(success[inside]),
            "still_landing_rate_in_range": mean(landings.still[inside]),
        }
    return metrics | failures(landings.outcomes[begun & ~success])


def trained_range(task: TaskCfg) -> dict[str, float]:
    """Return the distances straight ahead [m] that the levels of a task's training drew goals from."""
    lower, upper = zip(*((level.goal_lower[0], level.goal_upper[0]) for level in task.levels), strict=True)
    return {"trained_lower_m": max(min(lower), 0.0), "trained_upper_m": max(upper)}
