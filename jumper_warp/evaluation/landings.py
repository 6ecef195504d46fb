"""Jumps to landing positions: log, metrics, and flags of `jumper evaluate` and `play`.

The error of a jump is the horizontal distance between base and goal a second after touchdown, or at an earlier
failure. Second hops and steps after touchdown are reported separately.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
import tyro

from jumper_warp.evaluation.heights import MAX_ROBOTS
from jumper_warp.evaluation.jumps import REST_SPEED, REST_TIME, TAKEOFF_SPEED, JumpFlags, JumpLog, stance_metrics
from jumper_warp.evaluation.log import (
    COLLIDED,
    DIVERGED,
    SUCCESS,
    Metrics,
    failed_by,
    finite,
    mean,
    mean_and_max,
    termination_names,
    with_terminations,
    within,
)
from jumper_warp.kernels.jump import terminations
from jumper_warp.tasks.cfg import TaskCfg
from jumper_warp.tasks.terms import TerminationTerm
from jumper_warp.utils.errors import InputError

Position2D = tuple[float, float]  # [m] Ahead and to the left
SUCCESS_TOLERANCE = 0.1  # [m] Largest error of a successful jump
LANDING_TERMINATIONS = (DIVERGED, "low_base", COLLIDED, "no_jump", SUCCESS)
"""Terminations of a jump of an evaluation, in order of precedence; success is last, so that it hides no fall."""
FALLS = (DIVERGED, "low_base", COLLIDED)  # Terminations that `fall_rate` counts
MISSED = "missed"  # Outcome of a jump that landed, but beyond SUCCESS_TOLERANCE
EARLY = "early"  # Outcome of a landed jump that began before its command
AT_REST_AT_END = "below_0_1_m_s_at_the_end_rate"  # Metric: fraction of landed jumps with the base at rest at the end
JUMP_SECONDS, NEXT_JUMP_SECONDS = 3.5, 2.5  # [s] Length of a recording of one jump, and addition for each further jump


def with_landing_terminations(task: TaskCfg) -> TaskCfg:
    """Return a copy of the task with only LANDING_TERMINATIONS; its others, which shape training, are dropped."""
    return with_terminations(task, LANDING_TERMINATIONS)


def with_second_takeoff(task: TaskCfg) -> TaskCfg:
    """Return a copy of the task with LANDING_TERMINATIONS and, before success, the authors' second takeoff."""
    task = with_landing_terminations(task)
    takeoff = TerminationTerm(terminations.second_takeoff, speed=TAKEOFF_SPEED)
    return replace(task, terminations=(*task.terminations[:-1], takeoff, task.terminations[-1]))


class LandingLog(JumpLog):
    """Log of jumps to landing positions; arrays as in `JumpLog`, (num_envs, jumps in a row, ...).

    Success: begun on command and landed within SUCCESS_TOLERANCE.
    """

    spacing = 3.0

    @property
    def goal_positions(self) -> np.ndarray:
        """[m] (num_envs, jumps in a row, 2) Goals ahead and to the left of the start of each jump."""
        return self.goals[..., :2]

    @property
    def seconds(self) -> float:
        """[s] Maximum simulated time: each jump waits, squats and flies for at most 3.5 s."""
        return 1.0 + self.goals.shape[1] * (3.5 + self.rest) + float(np.max(self.delay))

    @property
    def offset(self) -> np.ndarray:
        """[m] (..., 2) Base minus goal at the end, ahead and to the left along the jump's heading."""
        x, y = np.moveaxis(self.end_position - self.goal_world, -1, 0)
        cos, sin = np.cos(-self.heading), np.sin(-self.heading)
        return np.stack([cos * x - sin * y, sin * x + cos * y], axis=-1)

    @property
    def landing(self) -> np.ndarray:
        """[m] (..., 2) Base position at the end, in the frame of `goal_positions`."""
        return self.goal_positions + self.offset

    @property
    def error(self) -> np.ndarray:
        """[m] (...) Horizontal distance of the base from the goal at the end; NaN if diverged or not begun."""
        invalid = self.diverged | ~np.isfinite(self.end_position).all(axis=-1)
        return np.where(invalid, np.nan, self.goal_distance(self.end_position))

    def goal_distance(self, position: np.ndarray) -> np.ndarray:
        """Return the distances [m], (num_envs, jumps in a row), of positions (..., 2) [m], world, from the goals."""
        return np.linalg.norm(position - self.goal_world, axis=-1)

    @property
    def success(self) -> np.ndarray:
        """Whether the jump began on command and landed within SUCCESS_TOLERANCE of its goal."""
        return self.landed & (np.nan_to_num(self.error, nan=np.inf) <= SUCCESS_TOLERANCE) & ~self.early

    @property
    def outcomes(self) -> np.ndarray:
        """Outcome of each jump: SUCCESS, MISSED or EARLY if it landed without success, else its entry in `ends`."""
        missed = np.where(self.landed & ~self.success, np.where(self.early, EARLY, MISSED), self.ends)
        return np.where(self.success, SUCCESS, missed)

    def columns(self) -> dict[str, list]:
        """Return goals, headings, landing positions, errors and outcomes, one value per jump, world after world."""
        columns = {f"goal_{axis}_m": self.goal_positions[..., i] for i, axis in enumerate("xy")}
        columns |= {"heading_deg": np.degrees(self.heading)}
        columns |= {f"landing_{axis}_m": self.landing[..., i] for i, axis in enumerate("xy")}
        columns |= {"error_m": self.error}
        ends = {"end": self.outcomes.ravel().tolist()}
        return {name: finite(values.ravel()) for name, values in columns.items()} | ends

    def series(self, worlds: Sequence[int]) -> dict[str, float]:
        """Return the base's height and its distance from the current goal [m] of some worlds."""
        offset = (self.arrays["base_pos"] - self.arrays["goal"])[list(worlds), :2]
        distances = zip(self.names(worlds), np.linalg.norm(offset, axis=1), strict=True)
        return super().series(worlds) | {f"distance/to goal, {name} [m]": distance for name, distance in distances}

    def goal_markers(self, worlds: Sequence[int]) -> np.ndarray:
        """Return the commanded goals [m], world frame, (worlds, jumps in a row, 3), z = 0."""
        return np.pad(self.goal_world[list(worlds)], ((0, 0), (0, 0), (0, 1)))

    def notes(self, worlds: Sequence[int]) -> dict[str, Any]:
        """Return the goals [m] of some worlds: key `goals_m`."""
        return {"goals_m": self.goal_positions[list(worlds)].tolist()}

    def labels(self, worlds: Sequence[int]) -> list[str]:
        """Return the first goals of some worlds in metres: "0.90 m" ahead, or "(0.80, 0.20) m" ahead and left."""
        goals = self.goal_positions[list(worlds), 0]
        return [f"{x:.2f} m" if y == 0.0 else f"({x:.2f}, {y:.2f}) m" for x, y in goals]


def landing_metrics(landings: LandingLog, inside: np.ndarray | None = None) -> Metrics:
    """Return the metrics of all commanded jumps of a log.

    Errors include failed jumps, but not those whose simulation diverged, which `came_apart` counts. `ahead` and `left`
    are signed. Tilts, turns, hops and steps are over landed jumps, `still_landing_rate` over all jumps and
    `second_takeoff_rate` over those that touched down. `fall_rate` and `miss_rate` count disjoint jumps: a miss has
    landed on its paws, but away from its goal.

    inside: mask of the jumps that the `in_range` metrics count, shaped like `landings.end`; None: no such metrics.
    """
    begun, error, success, landed = landings.begun, landings.error, landings.success, landings.landed
    offset = np.where(np.isnan(error)[..., None], np.nan, landings.offset)
    at_rest = "at_rest_within_1_s_rate" if landings.rest == REST_TIME else AT_REST_AT_END
    metrics: Metrics = {
        "jumps": int(begun.sum()), **mean_and_max("error_m", error),
        **mean_and_max("error_of_successes_m", error[success]), "mean_error_ahead_m": mean(offset[..., 0]),
        "mean_error_left_m": mean(offset[..., 1]), "success_rate": mean(success[begun]),
        "single_jump_success_rate": mean((success & ~landings.hopped)[begun]),
        "step_free_success_rate": mean((success & ~landings.stepped)[begun]), "landing_rate": mean(landed[begun]),
        "second_hop_rate": mean(landings.hopped[landed]), "step_rate": mean(landings.stepped[landed]),
        "mean_error_at_touchdown_m": mean(landings.goal_distance(landings.touchdown)[landed]),
        "mean_error_0_3_s_after_touchdown_m": mean(landings.goal_distance(landings.position_soon)[landed]),
        **stance_metrics(landings),
        "second_takeoff_rate": mean((landings.takeoffs > 0)[np.isfinite(landings.touchdown).all(axis=-1)]),
        at_rest: mean((landings.rest_speed < REST_SPEED)[landed]),
        "mean_landing_tilt_deg": mean(np.degrees(landings.tilt[landed])),
        "fall_rate": mean(np.isin(landings.ends, FALLS)[begun]),
        "miss_rate": mean((landings.outcomes == MISSED)[begun]), "early_rate": mean(landings.early[begun]),
        DIVERGED: int(landings.diverged.sum()),
    }  # fmt: skip
    if inside is not None:
        inside = begun & inside
        metrics |= {
            "mean_error_in_range_m": mean(error[inside]),
            "success_rate_in_range": mean(success[inside]),
            "still_landing_rate_in_range": mean(landings.still[inside]),
        }
    return metrics | failed_by(landings.outcomes[begun & ~success])


def trained_range(task: TaskCfg) -> dict[str, float]:
    """Return `trained_lower_m` and `trained_upper_m`, the range of goals straight ahead over all levels of a task."""
    lower, upper = zip(*((level.goal_lower[0], level.goal_upper[0]) for level in task.levels), strict=True)
    return {"trained_lower_m": max(min(lower), 0.0), "trained_upper_m": max(upper)}


def random_headings(count: int, seed: int) -> np.ndarray:
    """Return headings [rad] in -pi..pi, (count,), uniformly random."""
    return np.random.default_rng(seed).uniform(-math.pi, math.pi, count)


@dataclass(frozen=True)
class LandingFlags(JumpFlags):
    """Jumps to places from standing still."""

    goal_x: tuple[float, float] = (0.3, 1.5)
    """[m] Smallest and largest distance of the goal ahead; goals are evenly spaced."""
    goal_y: tuple[float, float] = (0.0, 0.0)
    """[m] Smallest and largest distance of the goal to the left; goals are sampled."""
    heading: Literal["any"] | float = "any"  # [deg] Heading of all robots, or any: sampled from the full circle

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in ("goal_x", "goal_y"):
            low, high = getattr(self, name)
            if not -10.0 < low <= high < 10.0:
                raise InputError(f"{name} must be in (-10, 10) m and rise, got {low}, {high}")
        if self.heading != "any" and not math.isfinite(self.heading):
            raise InputError(f"heading must be finite or any, got {self.heading}")

    def log(self, task: TaskCfg, seed: int) -> LandingLog:
        """Return the log of single jumps with these goals and headings, one per world."""
        rng = np.random.default_rng(seed)
        goals = np.stack([np.linspace(*self.goal_x, self.num_jumps), rng.uniform(*self.goal_y, self.num_jumps)], axis=1)
        headings = random_headings(self.num_jumps, seed) if self.heading == "any" else math.radians(self.heading)
        return LandingLog(goals[:, None], termination_names(task), headings)

    def metrics(self, log: LandingLog) -> Metrics:
        """Return `landing_metrics` and the range of its `in_range` metrics."""
        inside = within(np.linalg.norm(log.goal_positions, axis=-1), self.success_range)
        lower, upper = self.success_range
        return landing_metrics(log, inside) | {"range_lower_m": lower, "range_upper_m": upper}


@dataclass(frozen=True)
class LandingPlayFlags:
    """Jumps to places that are recorded."""

    goal: tyro.conf.UseAppendAction[tuple[Position2D, ...]] = ()
    """[m] Goal of a robot, ahead and to the left; give it once for each robot (default: three goals)."""
    next_goals: tyro.conf.UseAppendAction[tuple[Position2D, ...]] = ()
    """[m] Goal of all robots' next jump, ahead and to the left, a second after touchdown; give it once a jump."""
    default_goals: tyro.conf.Suppress[tuple[Position2D, ...]] = ((0.5, 0.0), (0.9, 0.0), (1.3, 0.0))
    """[m] Goals if there are none; flags that are given several times would be added to a default."""

    def __post_init__(self) -> None:
        for name in ("goal", "next_goals"):
            places = getattr(self, name)
            if len(places) > MAX_ROBOTS or not all(-10.0 < value < 10.0 for place in places for value in place):
                raise InputError(f"{name} takes up to {MAX_ROBOTS} places in (-10, 10) m, got {places}")

    @property
    def goals(self) -> tuple[Position2D, ...]:
        """[m] First goals, one per robot."""
        return self.goal or self.default_goals

    @property
    def length(self) -> float:
        """[s] Length of the recording."""
        return JUMP_SECONDS + NEXT_JUMP_SECONDS * len(self.next_goals)

    def log(self, task: TaskCfg) -> LandingLog:
        """Return the log of the jumps: each robot jumps to its goal of `goals`, then to all `next_goals`."""
        return LandingLog(np.array([[goal, *self.next_goals] for goal in self.goals]), termination_names(task))
