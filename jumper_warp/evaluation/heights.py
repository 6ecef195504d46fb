"""Jumps to heights: their log, the metrics of it, and the flags that make it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch
import tyro

from jumper_warp.envs.env import Env
from jumper_warp.evaluation.film import Film, Strip, moments
from jumper_warp.evaluation.jumps import DELAY, REST_SPEED, REST_TIME, STANCE, JumpFlags, JumpLog, stance_metrics
from jumper_warp.evaluation.log import (
    CAME_APART,
    COLLIDED,
    SUCCESS,
    Metrics,
    failures,
    finite,
    largest,
    mean,
    mean_and_max,
    run_evaluation,
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
SWEEP_ENDS = (CAME_APART, "low_base", "tilted", COLLIDED, "no_jump", "too_long", SUCCESS)
"""Terminations that end a jump of a sweep, in this order; the others only shape the training."""
FALLS = ("low_base", "tilted")
WRONG_HEIGHT = "wrong_height"
"""Outcome of a jump that came down from another height."""
DRIFT, TURN = 0.2, 25.0
"""[m], [deg] Of the base, beyond which the authors' configuration ends an episode."""
MAX_ROBOTS = 64
"""In one recording."""
LOWEST, HIGHEST, ABOVE = -0.37, 1.47, 0.45
"""[m] What pictures of a jump show at least, from the ground before it up, and what they leave above the base."""
SHOWN_HEIGHT = 1.0
"""[m] The filmstrip shows the jump nearest to this."""


def for_evaluation(task: TaskCfg) -> TaskCfg:
    """Return a task whose success is judged last, so that it hides no fall."""
    names = [term.name for term in task.terminations if term.name != SUCCESS]
    return with_ends(task, (*names, SUCCESS))


def for_sweep(task: TaskCfg) -> TaskCfg:
    """Return a task with the terminations that count in a sweep."""
    return with_ends(task, SWEEP_ENDS)


class HeightLog(JumpLog):
    """One jump to a height per world. A jump that landed within the task's limit, if it has one, is a success."""

    success, outcomes = JumpLog.landed, JumpLog.ends

    def __init__(self, heights: np.ndarray, terminations: tuple[str, ...], rest: float = REST_TIME) -> None:
        """heights: (num_envs,) [m] of the base; terminations, rest: as in `JumpLog`, rest at least REST_TIME."""
        goals = np.zeros((len(heights), 1, 3))
        goals[:, 0, 2] = heights
        super().__init__(goals, terminations, rest=rest)
        self.speed_time = REST_TIME

    @property
    def seconds(self) -> float:
        """[s] In which a jump has ended."""
        return 7.0 + self.rest

    def _mark_early(self, arrays: dict[str, np.ndarray], at: tuple[np.ndarray, np.ndarray]) -> None:
        """Mark the jumps that have begun when the command comes."""
        commanded = arrays["steps"] == arrays["command_step"]
        self.early[commanded] = (arrays["phase"] != STANCE)[commanded, None]

    @property
    def commanded(self) -> np.ndarray:
        """[m] Base height."""
        return self.goals[..., 2]

    @property
    def error(self) -> np.ndarray:
        """[m] Apex minus commanded height; NaN where the simulation came apart."""
        return np.where(self.broken | ~np.isfinite(self.apex), np.nan, self.apex - self.commanded)

    @property
    def reached(self) -> np.ndarray:
        """Whether the jump, begun on command, came near its height."""
        return (np.abs(self.error) <= SUCCESS_TOLERANCE) & ~self.early

    def columns(self) -> dict[str, list]:
        """Return commanded heights, apexes and errors [m] and the ends."""
        numbers = {"target_m": self.commanded, "apex_m": self.apex, "error_m": self.error}
        return {name: finite(values.ravel()) for name, values in numbers.items()} | {"end": self.ends.ravel().tolist()}

    def series(self, worlds: Sequence[int]) -> dict[str, float]:
        """Return the base's height and the commanded one [m]."""
        return super().series(worlds) | {f"height/target of {i} [m]": self.commanded[i, 0] for i in worlds}

    def notes(self, worlds: Sequence[int]) -> dict[str, Any]:
        """Return the commanded heights [m]."""
        return {"targets_m": self.commanded[list(worlds), 0].tolist()}

    def strip(self, film: Film) -> Strip:
        """Return pictures of the jump nearest to SHOWN_HEIGHT."""
        heights = self.commanded[film.worlds, 0]
        index = int(np.argmin(np.abs(heights - SHOWN_HEIGHT)))
        height = film.base(index)[:, 2]
        frames = moments(height, round(DELAY / film.env.step_dt) - 1)
        captions = [f"{(frame + 1) * film.env.step_dt:.2f} s, {height[frame]:.2f} m" for frame in frames]
        eye, target, size = view_of(float(height[frames].max()))
        return Strip(index, frames, captions, eye, target, size, name=f"jump_{heights[index]:.2f}_m")


def view_of(apex: float) -> tuple[tuple[float, float, float], tuple[float, float, float], tuple[int, int]]:
    """Return eye and target [m] and size [px] of pictures of a jump to an apex [m], as tall as it needs, one scale."""
    taller = max(1.0, (apex + ABOVE - LOWEST) / (HIGHEST - LOWEST))
    middle = LOWEST + 0.5 * taller * (HIGHEST - LOWEST)
    return (1.5 * taller, 2.0 * taller, middle + 0.35 * taller), (0.0, 0.0, middle), (320, round(420 * taller))


def run_jumps(act: Callable[[torch.Tensor], torch.Tensor], env: Env, heights: np.ndarray) -> HeightLog:
    """Let every world jump to its height (num_envs,) [m] once; act: as in `run_evaluation`."""
    jumps = HeightLog(heights, termination_names(env.task))
    run_evaluation(act, env, jumps)
    return jumps


def jump_metrics(jumps: HeightLog, in_range: tuple[float, float]) -> Metrics:
    """Return the metrics of jumps to heights.

    Errors are over all jumps, failed ones included, but those whose simulation came apart, which `came_apart` counts.
    Metrics of landings are over the successful jumps. in_range [m]: heights that `success_rate_in_range` counts.
    """
    success, outcomes = jumps.success, jumps.outcomes
    metrics: Metrics = {
        **height_metrics(jumps, in_range),
        "max_abs_error_of_successes_m": largest(np.abs(jumps.error)[success]),
        "success_rate": mean(success),
        "success_rate_in_range": mean(success[within(jumps.commanded, in_range)]),
        "range_lower_m": in_range[0],
        "range_upper_m": in_range[1],
        "at_rest_within_1_s_rate": mean((jumps.rest_speed < REST_SPEED)[success]),
        "mean_landing_tilt_deg": mean(np.degrees(jumps.tilt[success])),
        "fall_rate": mean(np.isin(outcomes, (*FALLS, COLLIDED, CAME_APART))),
        "miss_rate": mean(outcomes == WRONG_HEIGHT),
    }
    return metrics | failures(outcomes[~success])


def height_metrics(jumps: HeightLog, in_range: tuple[float, float]) -> Metrics:
    """Return the errors, and how landed jumps stand: a second takeoff, drift in the plane, turn."""
    error, landed = np.abs(jumps.error), jumps.landed
    beyond = (jumps.drift > DRIFT) | (np.degrees(np.abs(jumps.yaw)) > TURN)
    return {
        "jumps": len(jumps.end),
        "mean_abs_error_m": mean(error),
        "mean_abs_error_in_range_m": mean(error[within(jumps.commanded, in_range)]),
        **stance_metrics(jumps),
        "second_takeoff_rate": mean((jumps.takeoffs > 0)[landed]),
        **mean_and_max("drift_m", jumps.drift[landed]),
        "beyond_authors_drift_or_turn_rate": mean(beyond[landed]),
        CAME_APART: int(np.isnan(error).sum()),
    }


def sweep_metrics(jumps: HeightLog, in_range: tuple[float, float]) -> Metrics:
    """Return the metrics of jumps of which one succeeds that comes near its height, however it is landed.

    `miss_rate` is the share that began on command and landed, but came to another height; falls and collisions after
    the apex count neither there nor against the success.
    in_range [m]: heights that `success_rate_in_range` counts.
    """
    commanded, near = jumps.commanded, jumps.reached
    tilt, at_rest = np.where(np.isnan(jumps.error), 0.0, np.degrees(jumps.tilt)), jumps.rest_speed < REST_SPEED
    landed = jumps.landed & (tilt < LEVEL) & at_rest
    return {
        **height_metrics(jumps, in_range),
        "mean_error_m": mean(jumps.error),
        "success_rate": mean(near),
        "success_and_landing_rate": mean(near & landed),
        "success_rate_in_range": mean(near[within(commanded, in_range)]),
        "success_rate_0_6_1_1": mean(near[within(commanded, (0.6, 1.1))]),
        "largest_reached_m": largest(jumps.error + commanded),
        "landing_rate": mean(landed),
        "fall_rate": mean(np.isin(jumps.ends, FALLS)),
        "miss_rate": mean(jumps.landed & ~jumps.early & ~near),
        "no_jump_rate": mean(jumps.ends == "no_jump"),
        "early_rate": mean(jumps.early),
        "at_rest_within_1_s_rate": mean(at_rest),
        "largest_tilt_deg": largest(tilt),
    }


@dataclass(frozen=True)
class HeightFlags(JumpFlags):
    """Jumps to evenly spaced heights."""

    success_range: tuple[float, float] = field(default=(0.5, 1.1), kw_only=True)
    height_range: tuple[float, float] = (0.5, 1.2)
    """[m] Lowest and highest commanded base height."""

    def __post_init__(self) -> None:
        """Raises InputError: a setting is out of range."""
        super().__post_init__()
        if not 0.0 < self.height_range[0] <= self.height_range[1] < 10.0:
            raise InputError(f"height_range must be in (0, 10) m and rise, got {self.height_range}")

    def log(self, task: TaskCfg, seed: int) -> HeightLog:
        """Return jumps to these heights."""
        return HeightLog(np.linspace(*self.height_range, self.num_jumps), termination_names(task))

    def metrics(self, log: HeightLog) -> Metrics:
        """Return `jump_metrics`."""
        return jump_metrics(log, self.success_range)


@dataclass(frozen=True)
class HeightGoals:
    """Jumps to heights that are recorded."""

    height: tuple[float, ...] = (0.6, 0.9, 1.1)
    """[m] Commanded base heights, one robot each."""
    length: tyro.conf.Suppress[float] = 3.5
    """[s] Of the recording, unless another is given."""

    def __post_init__(self) -> None:
        """Raises InputError: a height is out of range, or their number."""
        if not 1 <= len(self.height) <= MAX_ROBOTS or not all(0.0 < height < 10.0 for height in self.height):
            raise InputError(f"height takes 1 to {MAX_ROBOTS} numbers in (0, 10) m, got {self.height}")

    def log(self, task: TaskCfg) -> HeightLog:
        """Return one jump a robot."""
        return HeightLog(np.array(self.height), termination_names(task))
