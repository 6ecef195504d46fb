"""Evaluation of jumps to landing positions: log, metrics, and flags of `jumper evaluate` and `play`."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
import tyro

from jumper_warp.evaluation.heights import MAX_ROBOTS
from jumper_warp.evaluation.jump_metrics import JumpFlags
from jumper_warp.evaluation.jumps import TAKEOFF_SPEED, JumpLog, with_jump_terminations
from jumper_warp.evaluation.log import termination_names
from jumper_warp.kernels.jump import terminations
from jumper_warp.tasks.cfg import TaskCfg
from jumper_warp.tasks.terms import TerminationTerm
from jumper_warp.utils.checks import check_finite
from jumper_warp.utils.errors import InputError

Position2D = tuple[float, float]  # [m] Ahead and to the left
PAPER = {
    "success_rate": 0.97, "in_range_success_rate": 1.0, "goal_distance_at_rest_mean_m": 0.026,
    "goal_distance_at_end_mean_m": 0.026,
}  # fmt: skip
"""Metrics of the paper's simulation by key."""
JUMP_SECONDS, NEXT_JUMP_SECONDS = 3.5, 2.5  # [s] Length of a recording of one jump, and addition for each further jump


def with_second_takeoff(task: TaskCfg) -> TaskCfg:
    """Return a copy of a task with the authors' termination at a second takeoff, which precedes success."""
    task = with_jump_terminations(task)
    takeoff = TerminationTerm(terminations.second_takeoff, speed=TAKEOFF_SPEED)
    return replace(task, terminations=(*task.terminations[:-1], takeoff, task.terminations[-1]))


class LandingLog(JumpLog):
    """Log of jumps to landing positions; arrays have shape (num_envs, jumps in a row, ...), see `JumpLog`."""

    spacing = 3.0
    main_columns = ("goal_x_m", "goal_y_m", "distance_at_rest_m", "apex_m", "tilt_deg", "outcome")

    @property
    def goal_positions(self) -> np.ndarray:
        """Goals ahead and to the left of the start of each jump [m], (num_envs, jumps in a row, 2)."""
        return self.goals[..., :2]

    @property
    def seconds(self) -> float:
        """Maximum simulated time [s]: each jump waits, squats and flies for at most 3.5 s."""
        return 1.0 + self.goals.shape[1] * (3.5 + self.rest) + float(np.max(self.delay))

    @property
    def landing(self) -> np.ndarray:
        """Base position at the end of each jump [m], in the frame of `goal_positions`, (..., 2)."""
        x, y = np.moveaxis(self.end_position - self.goal_world, -1, 0)
        cos, sin = np.cos(self.heading), np.sin(self.heading)
        return self.goal_positions + np.stack([cos * x + sin * y, cos * y - sin * x], axis=-1)

    def series(self, worlds: Sequence[int]) -> dict[str, float]:
        """Return the current base height, and distance of the base from the current goal, [m] of some worlds."""
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


def random_headings(count: int, seed: int) -> np.ndarray:
    """Return uniformly random headings [rad] in -pi..pi, (count,)."""
    return np.random.default_rng(seed).uniform(-math.pi, math.pi, count)


@dataclass(frozen=True)
class LandingFlags(JumpFlags):
    """Flags of jumps to landing positions from rest in the default pose."""

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
        if self.heading != "any":
            check_finite("heading", self.heading)

    def log(self, task: TaskCfg, seed: int) -> LandingLog:
        """Return a new log of one jump per world, with goals and headings from the flags."""
        rng = np.random.default_rng(seed)
        goals = np.stack([np.linspace(*self.goal_x, self.num_jumps), rng.uniform(*self.goal_y, self.num_jumps)], axis=1)
        headings = random_headings(self.num_jumps, seed) if self.heading == "any" else math.radians(self.heading)
        return LandingLog(goals[:, None], termination_names(task), headings)


@dataclass(frozen=True)
class LandingPlayFlags:
    """Flags of recorded jumps to landing positions."""

    goal: tyro.conf.UseAppendAction[tuple[Position2D, ...]] = ()
    """[m] Goal of a robot, ahead and to the left; repeat the flag for each robot (default: three goals)."""
    next_goals: tyro.conf.UseAppendAction[tuple[Position2D, ...]] = ()
    """[m] Goal of all robots' next jump, ahead and to the left, a second after touchdown; repeat it for each jump."""
    default_goals: tyro.conf.Suppress[tuple[Position2D, ...]] = ((0.5, 0.0), (0.9, 0.0), (1.3, 0.0))
    """[m] Goals if `goal` is not passed; a default of `goal` itself would be kept when the flag is passed."""

    def __post_init__(self) -> None:
        for name in ("goal", "next_goals"):
            places = getattr(self, name)
            if len(places) > MAX_ROBOTS or not all(-10.0 < value < 10.0 for place in places for value in place):
                raise InputError(f"{name} takes up to {MAX_ROBOTS} positions in (-10, 10) m, got {places}")

    @property
    def goals(self) -> tuple[Position2D, ...]:
        """First goal of each robot [m], ahead and to the left."""
        return self.goal or self.default_goals

    @property
    def length(self) -> float:
        """Length of the recording [s]."""
        return JUMP_SECONDS + NEXT_JUMP_SECONDS * len(self.next_goals)

    def log(self, task: TaskCfg) -> LandingLog:
        """Return the log of the jumps: each robot jumps to its goal of `goals`, then to all `next_goals`."""
        return LandingLog(np.array([[goal, *self.next_goals] for goal in self.goals]), termination_names(task))
