"""Jumps to apex heights: log, metrics, and flags of `jumper evaluate` and `play`."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch
import tyro

from jumper_warp.envs.env import Env
from jumper_warp.evaluation.jumps import REST_SPEED, REST_TIME, STANCE, JumpFlags, JumpLog, stance_metrics
from jumper_warp.evaluation.log import (
    COLLIDED,
    DIVERGED,
    SUCCESS,
    Metrics,
    failed_by,
    finite,
    largest,
    mean,
    mean_and_max,
    run_evaluation,
    termination_names,
    with_terminations,
    within,
)
from jumper_warp.tasks.cfg import TaskCfg
from jumper_warp.utils.errors import InputError

SUCCESS_TOLERANCE = 0.1  # [m] Largest difference between apex and commanded height of a jump that reaches its height
LEVEL_TILT = 10.0  # [deg] Tilt of the base below which a landing of a sweep is good
SWEEP_ENDS = (DIVERGED, "low_base", "tilted", COLLIDED, "no_jump", "too_long", SUCCESS)
"""Terminations of a jump of a sweep, in order of precedence; others of the task, which shape training, are dropped."""
FALLS = ("low_base", "tilted")
WRONG_HEIGHT = "wrong_height"  # Outcome of a jump that landed from another apex height than commanded
DRIFT, TURN = 0.2, 25.0  # [m], [deg] Drift and turn of the base beyond which the authors' configuration ends an episode
MAX_ROBOTS = 64  # Maximum number of robots in one recording


def with_success_last(task: TaskCfg) -> TaskCfg:
    """Return a copy of the task with the termination SUCCESS checked last, so that it hides no fall."""
    names = [term.name for term in task.terminations if term.name != SUCCESS]
    return with_terminations(task, (*names, SUCCESS))


def with_sweep_terminations(task: TaskCfg) -> TaskCfg:
    """Return a copy of the task with the terminations of a sweep, SWEEP_ENDS."""
    return with_terminations(task, SWEEP_ENDS)


class HeightLog(JumpLog):
    """Log of one jump to an apex height per world; arrays of `JumpLog` have shape (num_envs, 1).

    Success: landed, stayed up until the jump was over, and no termination of the task failed it.
    """

    success, outcomes = JumpLog.landed, JumpLog.ends

    def __init__(self, heights: np.ndarray, terminations: tuple[str, ...], rest: float = REST_TIME) -> None:
        """Start with no jump ended.

        heights [m]: commanded base heights at the apex, (num_envs,), above the ground; terminations, rest: as in
        `JumpLog`, rest at least REST_TIME.
        """
        goals = np.zeros((len(heights), 1, 3))
        goals[:, 0, 2] = heights
        super().__init__(goals, terminations, rest=rest)
        self.speed_time = REST_TIME

    @property
    def seconds(self) -> float:
        """[s] Maximum simulated time."""
        return 7.0 + self.rest

    def _record_early(self, arrays: dict[str, np.ndarray], at: tuple[np.ndarray, np.ndarray]) -> None:
        """Mark jumps that have left the stance phase in the step of the command; `at` is unused."""
        commanded = arrays["steps"] == arrays["command_step"]
        self.early[commanded] = (arrays["phase"] != STANCE)[commanded, None]

    @property
    def commanded(self) -> np.ndarray:
        """[m] (num_envs, 1) Commanded base height at the apex."""
        return self.goals[..., 2]

    @property
    def error(self) -> np.ndarray:
        """[m] (num_envs, 1) Apex minus commanded height; NaN where the simulation diverged."""
        return np.where(self.diverged | ~np.isfinite(self.apex), np.nan, self.apex - self.commanded)

    @property
    def reached(self) -> np.ndarray:
        """(num_envs, 1) Whether the jump began on command, with its apex within SUCCESS_TOLERANCE of the command."""
        return (np.abs(self.error) <= SUCCESS_TOLERANCE) & ~self.early

    def columns(self) -> dict[str, list]:
        """Return lists with one value per jump: target_m (commanded height), apex_m, error_m, end (termination)."""
        columns = {"target_m": self.commanded, "apex_m": self.apex, "error_m": self.error}
        return {name: finite(values.ravel()) for name, values in columns.items()} | {"end": self.ends.ravel().tolist()}

    def series(self, worlds: Sequence[int]) -> dict[str, float]:
        """Return the base's present and commanded height [m] of some worlds."""
        targets = zip(self.names(worlds), self.commanded[list(worlds), 0], strict=True)
        return super().series(worlds) | {f"height/command, {name} [m]": height for name, height in targets}

    def notes(self, worlds: Sequence[int]) -> dict[str, Any]:
        """Return the commanded heights [m] of some worlds: key `targets_m`."""
        return {"targets_m": self.commanded[list(worlds), 0].tolist()}

    def goal_heights(self, worlds: Sequence[int]) -> np.ndarray:
        """Return the commanded heights [m] of some worlds, (worlds,)."""
        return self.commanded[list(worlds), 0]

    def labels(self, worlds: Sequence[int]) -> list[str]:
        """Return the commanded heights of some worlds in metres, such as "0.90 m"."""
        return [f"{self.commanded[world, 0]:.2f} m" for world in worlds]


def run_jumps(act: Callable[[torch.Tensor], torch.Tensor], env: Env, heights: np.ndarray) -> HeightLog:
    """Run one jump per world to commanded heights [m], (num_envs,), return the log; act: as in `run_evaluation`."""
    jumps = HeightLog(heights, termination_names(env.task))
    run_evaluation(act, env, jumps)
    return jumps


def apex_metrics(jumps: HeightLog, in_range: tuple[float, float]) -> Metrics:
    """Return the metrics of `jumper evaluate`, where a jump succeeds if none of the task's terminations ends it.

    Errors include failed jumps, but not diverged ones, which `came_apart` counts. `fall_rate` counts falls, collisions
    and diverged jumps. Metrics of landings are of successful jumps. in_range [m]: heights of the `in_range` metrics.
    """
    success, outcomes = jumps.success, jumps.outcomes
    metrics: Metrics = {
        **apex_error_metrics(jumps, in_range), "max_abs_error_of_successes_m": largest(np.abs(jumps.error)[success]),
        "success_rate": mean(success), "success_rate_in_range": mean(success[within(jumps.commanded, in_range)]),
        "range_lower_m": in_range[0], "range_upper_m": in_range[1],
        "at_rest_within_1_s_rate": mean((jumps.rest_speed < REST_SPEED)[success]),
        "mean_landing_tilt_deg": mean(np.degrees(jumps.tilt[success])),
        "fall_rate": mean(np.isin(outcomes, (*FALLS, COLLIDED, DIVERGED))), "miss_rate": mean(outcomes == WRONG_HEIGHT),
    }  # fmt: skip
    return metrics | failed_by(outcomes[~success])


def apex_error_metrics(jumps: HeightLog, in_range: tuple[float, float]) -> Metrics:
    """Return the metrics common to `apex_metrics` and `sweep_metrics`: apex errors of all jumps, stance of landed ones.

    in_range [m]: commanded heights that `mean_abs_error_in_range_m` counts.
    """
    error, landed = np.abs(jumps.error), jumps.landed
    beyond = (jumps.drift > DRIFT) | (np.degrees(np.abs(jumps.yaw)) > TURN)
    return {
        "jumps": len(jumps.end), "mean_abs_error_m": mean(error),
        "mean_abs_error_in_range_m": mean(error[within(jumps.commanded, in_range)]), **stance_metrics(jumps),
        "second_takeoff_rate": mean((jumps.takeoffs > 0)[landed]), **mean_and_max("drift_m", jumps.drift[landed]),
        "beyond_authors_drift_or_turn_rate": mean(beyond[landed]), DIVERGED: int(np.isnan(error).sum()),
    }  # fmt: skip


def sweep_metrics(jumps: HeightLog, in_range: tuple[float, float]) -> Metrics:
    """Return the metrics of a sweep, where a jump succeeds if it reaches its height, however it lands.

    `miss_rate` is the fraction that began on command and landed, but from another height; falls and collisions after
    the apex count neither as misses nor against the success. in_range [m]: heights that the `in_range` metrics count.
    """
    commanded, near = jumps.commanded, jumps.reached
    tilt, at_rest = np.where(np.isnan(jumps.error), 0.0, np.degrees(jumps.tilt)), jumps.rest_speed < REST_SPEED
    landed = jumps.landed & (tilt < LEVEL_TILT) & at_rest
    return {
        **apex_error_metrics(jumps, in_range), "mean_error_m": mean(jumps.error), "success_rate": mean(near),
        "success_and_landing_rate": mean(near & landed),
        "success_rate_in_range": mean(near[within(commanded, in_range)]),
        "success_rate_0_6_1_1": mean(near[within(commanded, (0.6, 1.1))]),
        "largest_reached_m": largest(jumps.error + commanded), "landing_rate": mean(landed),
        "fall_rate": mean(np.isin(jumps.ends, FALLS)), "miss_rate": mean(jumps.landed & ~jumps.early & ~near),
        "no_jump_rate": mean(jumps.ends == "no_jump"), "early_rate": mean(jumps.early),
        "at_rest_within_1_s_rate": mean(at_rest), "largest_tilt_deg": largest(tilt),
    }  # fmt: skip


@dataclass(frozen=True)
class HeightFlags(JumpFlags):
    """Jumps to evenly spaced heights."""

    success_range: tuple[float, float] = field(default=(0.5, 1.1), kw_only=True)
    height_range: tuple[float, float] = (0.5, 1.2)  # [m] Lowest and highest commanded base height

    def __post_init__(self) -> None:
        super().__post_init__()
        if not 0.0 < self.height_range[0] <= self.height_range[1] < 10.0:
            raise InputError(f"height_range must be in (0, 10) m and rise, got {self.height_range}")

    def log(self, task: TaskCfg, seed: int) -> HeightLog:
        """Return the log of jumps to these heights, one per world; seed has no effect."""
        return HeightLog(np.linspace(*self.height_range, self.num_jumps), termination_names(task))

    def metrics(self, log: HeightLog) -> Metrics:
        """Return `apex_metrics` of a finished log."""
        return apex_metrics(log, self.success_range)


@dataclass(frozen=True)
class HeightPlayFlags:
    """Jumps to heights that are recorded."""

    height: tuple[float, ...] = (0.6, 0.9, 1.1)  # [m] Commanded base heights, one robot each
    length: tyro.conf.Suppress[float] = 3.5  # [s] Length of the recording, unless `jumper play --seconds` sets it

    def __post_init__(self) -> None:
        if not 1 <= len(self.height) <= MAX_ROBOTS or not all(0.0 < height < 10.0 for height in self.height):
            raise InputError(f"height takes 1 to {MAX_ROBOTS} numbers in (0, 10) m, got {self.height}")

    def log(self, task: TaskCfg) -> HeightLog:
        """Return the log of the jumps, one per robot."""
        return HeightLog(np.array(self.height), termination_names(task))
