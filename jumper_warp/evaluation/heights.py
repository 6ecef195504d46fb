"""Jumps to heights: what is asked for, and the metrics of what became of it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from jumper_warp.evaluation.jumps import REST_SPEED, Jumps
from jumper_warp.evaluation.log import (
    CAME_APART,
    COLLIDED,
    SUCCESS,
    Metrics,
    failures,
    largest,
    mean,
    termination_names,
    with_ends,
    within,
)
from jumper_warp.tasks.cfg import TaskCfg
from jumper_warp.utils.errors import InputError

SUCCESS_TOLERANCE = 0.1
"""[m] A jump that comes this close reaches its height."""
LEVEL = 10.0
"""[deg] A good landing tilts the base less."""
FALLS = ("low_base", "tilted")
WRONG_HEIGHT = "wrong_height"
"""Outcome of a jump that came down from another height."""
DRIFT, TURN = 0.2, 25.0
"""[m], [deg] Of the base, beyond which the authors' configuration ends an episode."""
MAX_ROBOTS = 64
"""In one recording."""


def for_evaluation(task: TaskCfg) -> TaskCfg:
    """Return a task whose success is judged last, so that it hides no fall."""
    names = [term.name for term in task.terminations if term.name != SUCCESS]
    return with_ends(task, (*names, SUCCESS))


def jump_metrics(jumps: Jumps, in_range: tuple[float, float]) -> Metrics:
    """Return the metrics of vertical jumps.

    Errors are over all jumps, failed ones included, but those whose simulation came apart, which `came_apart` counts.
    What is told of landings is over the successful jumps. in_range [m]: targets that `success_rate_in_range` counts.
    """
    inside = within(jumps.target, in_range)
    error, success = np.abs(jumps.error), jumps.success
    outcomes = jumps.outcomes
    metrics: Metrics = {
        "jumps": len(jumps.target),
        "mean_abs_error_m": mean(error),
        "mean_abs_error_in_range_m": mean(error[inside]),
        "max_abs_error_of_successes_m": largest(error[success]),
        "success_rate": float(success.mean()),
        "success_rate_in_range": mean(success[inside]),
        "range_lower_m": in_range[0],
        "range_upper_m": in_range[1],
        "at_rest_within_1_s_rate": mean((jumps.rest_speed < REST_SPEED)[success]),
        "mean_landing_tilt_deg": mean(np.degrees(jumps.tilt[success])),
        "max_landing_tilt_deg": largest(np.degrees(jumps.tilt[success])),
        **landing_metrics(jumps),
        "collision_rate": float((outcomes == COLLIDED).mean()),
        "fall_rate": float(np.isin(outcomes, (*FALLS, COLLIDED, CAME_APART)).mean()),
        "miss_rate": float((outcomes == WRONG_HEIGHT).mean()),
        CAME_APART: int(np.isnan(jumps.error).sum()),
    }
    return metrics | failures(outcomes[~success])


def landing_metrics(jumps: Jumps) -> Metrics:
    """Return what became of the robots that landed: still paws, second takeoffs, drift in the plane and turn.

    `still_landing_rate` is of all jumps, the others of the landed ones.
    """
    landed, turn = jumps.success, np.degrees(np.abs(jumps.yaw))
    return {
        "still_landing_rate": float(jumps.still.mean()),
        "second_takeoff_rate": mean((jumps.takeoffs > 0)[landed]),
        "mean_drift_m": mean(jumps.drift[landed]),
        "max_drift_m": largest(jumps.drift[landed]),
        "mean_turn_deg": mean(turn[landed]),
        "max_turn_deg": largest(turn[landed]),
        "beyond_authors_drift_or_turn_rate": mean(((jumps.drift > DRIFT) | (turn > TURN))[landed]),
    }


def reached(jumps: Jumps) -> np.ndarray:
    """Return which jumps, begun on command, came near their height."""
    return (np.abs(jumps.error) <= SUCCESS_TOLERANCE) & ~jumps.early


def sweep_metrics(jumps: Jumps, in_range: tuple[float, float]) -> Metrics:
    """Return the metrics of jumps of which one succeeds that comes near its height, however it is landed.

    `miss_rate` is the share that began on command and landed, but came to another height; falls and collisions after
    the apex are told apart from it, and from the success.
    in_range [m]: targets that `success_rate_in_range` counts.
    """
    target, error, near = jumps.target, np.abs(jumps.error), reached(jumps)
    tilt = np.where(np.isnan(error), 0.0, np.degrees(jumps.tilt))
    landed = jumps.success & (tilt < LEVEL) & (jumps.rest_speed < REST_SPEED)
    return {
        "jumps": len(target),
        "mean_abs_error_m": mean(error),
        "mean_abs_error_in_range_m": mean(error[within(target, in_range)]),
        "mean_error_m": mean(jumps.error),
        "success_rate": float(near.mean()),
        "success_and_landing_rate": float((near & landed).mean()),
        "success_rate_in_range": mean(near[within(target, in_range)]),
        "success_rate_0_6_1_1": mean(near[within(target, (0.6, 1.1))]),
        "largest_reached_m": largest(jumps.error + target),
        "landing_rate": float(landed.mean()),
        "max_landing_tilt_deg": largest(np.degrees(jumps.tilt[jumps.success])),
        **landing_metrics(jumps),
        "collision_rate": float((jumps.outcomes == COLLIDED).mean()),
        "fall_rate": float(np.isin(jumps.outcomes, FALLS).mean()),
        "miss_rate": float((jumps.success & ~jumps.early & ~near).mean()),
        "no_jump_rate": float((jumps.outcomes == "no_jump").mean()),
        "early_rate": float(jumps.early.mean()),
        "at_rest_within_1_s_rate": float((jumps.rest_speed < REST_SPEED).mean()),
        "largest_tilt_deg": float(tilt.max()),
        "came_apart": int(np.isnan(jumps.error).sum()),
    }


@dataclass(frozen=True)
class HeightFlags:
    """Jumps to evenly spaced heights."""

    jumps: int = 200
    """Number of jumps."""
    lower: float = 0.5
    """[m] Lowest commanded base height."""
    upper: float = 1.2
    """[m] Highest."""
    in_range: tuple[float, float] = (0.5, 1.1)
    """[m] Heights that the success rate in range counts."""

    def __post_init__(self) -> None:
        """Raises InputError: a setting is out of range."""
        check_jumps(self.jumps, self.in_range)
        if not 0.0 < self.lower <= self.upper < 10.0:
            raise InputError(f"heights must be in (0, 10) m and rise, got {self.lower}, {self.upper}")

    @property
    def count(self) -> int:
        """Number of worlds."""
        return self.jumps

    def log(self, task: TaskCfg, seed: int) -> Jumps:
        """Return jumps to these heights."""
        return Jumps(np.linspace(self.lower, self.upper, self.jumps), termination_names(task))

    def metrics(self, log: Jumps) -> Metrics:
        """Return `jump_metrics`."""
        return jump_metrics(log, self.in_range)


def check_jumps(jumps: int, in_range: tuple[float, float]) -> None:
    """Raise InputError unless there is a jump and a range [m]."""
    if jumps < 1:
        raise InputError(f"jumps must be at least 1, got {jumps}")
    if not 0.0 <= in_range[0] <= in_range[1] < 10.0:
        raise InputError(f"in_range must be in [0, 10) m and rise, got {in_range[0]}, {in_range[1]}")


@dataclass(frozen=True)
class HeightGoals:
    """Jumps to heights that are recorded."""

    height: tuple[float, ...] = (0.6, 0.9, 1.1)
    """[m] Commanded base heights, one robot each."""

    spacing = Jumps.spacing
    seconds = 3.5

    def __post_init__(self) -> None:
        """Raises InputError: a height is out of range, or their number."""
        if not 1 <= len(self.height) <= MAX_ROBOTS or not all(0.0 < height < 10.0 for height in self.height):
            raise InputError(f"height takes 1 to {MAX_ROBOTS} numbers in (0, 10) m, got {self.height}")

    @property
    def count(self) -> int:
        """Number of worlds."""
        return len(self.height)

    @property
    def notes(self) -> dict[str, Any]:
        """What to save with the recording."""
        return {"heights_m": self.height}

    def log(self, task: TaskCfg) -> Jumps:
        """Return one jump a robot."""
        return Jumps(np.array(self.height), termination_names(task))


@dataclass(frozen=True)
class MarsHeightGoals(HeightGoals):
    """Jumps to heights that are recorded, with flights of up to 2.7 s."""

    seconds = 6.0
