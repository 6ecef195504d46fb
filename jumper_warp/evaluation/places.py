"""Jumps to places in the plane: their log, the metrics of it, and the flags that make it.

A jump is over once the robot has had a second to come to rest; the distance between base and goal then is its error. A
jump that fails before is measured where it failed. Hops and steps on the way there are reported separately.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
import tyro

from jumper_warp.evaluation.film import PICTURE, Film, Strip, beside, moments
from jumper_warp.evaluation.heights import MAX_ROBOTS
from jumper_warp.evaluation.jumps import REST_SPEED, REST_TIME, TAKEOFF_SPEED, JumpFlags, JumpLog, stance_metrics
from jumper_warp.evaluation.log import (
    CAME_APART,
    COLLIDED,
    SUCCESS,
    Metrics,
    failures,
    finite,
    mean,
    mean_and_max,
    termination_names,
    with_ends,
    within,
)
from jumper_warp.kernels.jump import terminations
from jumper_warp.tasks.cfg import TaskCfg
from jumper_warp.tasks.terms import TerminationTerm
from jumper_warp.utils.errors import InputError

Place = tuple[float, float]
SUCCESS_TOLERANCE = 0.1
"""[m] A landed jump that ends this close to its goal succeeds."""
ENDS = (CAME_APART, "low_base", COLLIDED, "no_jump", SUCCESS)
"""Terminations of the task that end a jump here, in this order, so that no success hides a fall; the others only shape
the training."""
FALLS = (CAME_APART, "low_base", COLLIDED)
MISSED = "missed"
"""Outcome of a jump that landed well, but elsewhere."""
EARLY = "early"
"""Outcome of a jump that began before the command."""
AT_END = "below_0_1_m_s_at_the_end_rate"
"""Name of the share of landed jumps whose base was at rest (`REST_SPEED`) when the jump was over."""
SECONDS, SECONDS_MORE = 3.5, 2.5
"""[s] Of a recording, and for each further jump."""
SHOWN_DISTANCE = 1.0
"""[m] The filmstrip shows the jump nearest to this."""


def for_evaluation(task: TaskCfg) -> TaskCfg:
    """Return a task with the terminations that count in an evaluation."""
    return with_ends(task, ENDS)


def ended_by_takeoff(task: TaskCfg) -> TaskCfg:
    """Return the same, and a second takeoff after landing ends the jump, as in the authors' configuration."""
    task = for_evaluation(task)
    takeoff = TerminationTerm(terminations.second_takeoff, speed=TAKEOFF_SPEED)
    return replace(task, terminations=(*task.terminations[:-1], takeoff, task.terminations[-1]))


class PlaceLog(JumpLog):
    """Jumps to places in the plane. One that begins on command and lands within SUCCESS_TOLERANCE is a success."""

    spacing = 3.0

    @property
    def places(self) -> np.ndarray:
        """[m] (..., 2) Goals, ahead and to the left."""
        return self.goals[..., :2]

    @property
    def seconds(self) -> float:
        """[s] In which a row has ended: a jump waits, squats and flies for at most 3.5 s."""
        return 1.0 + self.goals.shape[1] * (3.5 + self.rest) + float(np.max(self.delay))

    @property
    def offset(self) -> np.ndarray:
        """[m] (..., 2) From goal to base at the end, ahead and to the left of the jump's heading."""
        x, y = np.moveaxis(self.place - self.target, -1, 0)
        cos, sin = np.cos(-self.heading), np.sin(-self.heading)
        return np.stack([cos * x - sin * y, sin * x + cos * y], axis=-1)

    @property
    def landing(self) -> np.ndarray:
        """[m] (..., 2) Base at the end, where the goals are measured."""
        return self.places + self.offset

    @property
    def error(self) -> np.ndarray:
        """[m] Distance of the base from the goal at the end; NaN where the simulation came apart."""
        broken = self.broken | ~np.isfinite(self.place).all(axis=-1)
        return np.where(broken, np.nan, self.distance(self.place))

    def distance(self, place: np.ndarray) -> np.ndarray:
        """Return the distance [m] of places (..., 2), world, from the goals."""
        return np.linalg.norm(place - self.target, axis=-1)

    @property
    def success(self) -> np.ndarray:
        """Whether the jump, begun on command, was landed near its goal."""
        return self.landed & (np.nan_to_num(self.error, nan=np.inf) <= SUCCESS_TOLERANCE) & ~self.early

    @property
    def outcomes(self) -> np.ndarray:
        """Name of each jump's end, MISSED or EARLY where it was landed without success."""
        missed = np.where(self.landed & ~self.success, np.where(self.early, EARLY, MISSED), self.ends)
        return np.where(self.success, SUCCESS, missed)

    def columns(self) -> dict[str, list]:
        """Return goals, headings, landings and errors, and the ends; row after row."""
        numbers = {f"goal_{axis}_m": self.places[..., i] for i, axis in enumerate("xy")}
        numbers |= {"heading_deg": np.degrees(self.heading)}
        numbers |= {f"landing_{axis}_m": self.landing[..., i] for i, axis in enumerate("xy")}
        numbers |= {"error_m": self.error}
        ends = {"end": self.outcomes.ravel().tolist()}
        return {name: finite(values.ravel()) for name, values in numbers.items()} | ends

    def series(self, worlds: Sequence[int]) -> dict[str, float]:
        """Return the base's height and its distance from the current goal [m]."""
        way = np.linalg.norm((self.seen["base_pos"] - self.seen["goal"])[:, :2], axis=1)
        return super().series(worlds) | {f"distance/goal of {world} [m]": way[world] for world in worlds}

    def marks(self, worlds: Sequence[int]) -> np.ndarray:
        """Return the goals that were commanded [m], world frame, (worlds, jumps in a row, 3), z = 0."""
        target = self.target[list(worlds)]
        return np.concatenate([target, np.zeros_like(target[..., :1])], axis=-1)

    def notes(self, worlds: Sequence[int]) -> dict[str, Any]:
        """Return the goals [m]."""
        return {"goals_m": self.places[list(worlds)].tolist()}

    def strip(self, film: Film) -> Strip:
        """Return pictures of the jump, or row of jumps, that begins with about SHOWN_DISTANCE."""
        distance = np.linalg.norm(self.places[film.worlds, 0], axis=1)
        index = int(np.argmin(np.abs(distance - SHOWN_DISTANCE)))
        base = film.base(index)
        if self.places.shape[1] == 1:
            delay = np.broadcast_to(self.delay, film.env.num_envs)[film.worlds[index]]
            frames = moments(base[:, 2], round(delay / film.env.step_dt) - 1)
        else:
            frames = np.linspace(0, len(base) - 1, 9).round().astype(int).tolist()
        ends = self.place[film.worlds[index]]
        eye, target = beside(base[0, :2], ends[np.isfinite(ends[:, 0])][-1])
        captions = [f"{(frame + 1) * film.env.step_dt:.2f} s" for frame in frames]
        return Strip(index, frames, captions, eye, target, PICTURE)


def landing_metrics(landings: PlaceLog, inside: np.ndarray | None = None) -> Metrics:
    """Return the metrics of jumps to places, all rows together.

    Errors are over all jumps, failed ones included, but those whose simulation came apart, which `came_apart` counts,
    and those that were not begun. `ahead` and `left` are signed. Tilts, turns, hops and steps are those of the landed
    jumps. `still_landing_rate` is of all jumps, `second_takeoff_rate` of those that came down. `fall_rate` and
    `miss_rate` share no jump: one that misses has landed on its paws, but elsewhere.

    inside: which jumps the metrics in range count, shaped like `landings.end`; without it there are none.
    """
    begun, error, success, landed = landings.begun, landings.error, landings.success, landings.landed
    offset = np.where(np.isnan(error)[..., None], np.nan, landings.offset)
    at_rest = "at_rest_within_1_s_rate" if landings.rest == REST_TIME else AT_END
    metrics: Metrics = {
        "jumps": int(begun.sum()),
        **mean_and_max("error_m", error),
        **mean_and_max("error_of_successes_m", error[success]),
        "mean_error_ahead_m": mean(offset[..., 0]),
        "mean_error_left_m": mean(offset[..., 1]),
        "success_rate": mean(success[begun]),
        "single_jump_success_rate": mean((success & ~landings.hopped)[begun]),
        "step_free_success_rate": mean((success & ~landings.stepped)[begun]),
        "landing_rate": mean(landed[begun]),
        "second_hop_rate": mean(landings.hopped[landed]),
        "step_rate": mean(landings.stepped[landed]),
        "mean_error_at_touchdown_m": mean(landings.distance(landings.touchdown)[landed]),
        "mean_error_0_3_s_after_touchdown_m": mean(landings.distance(landings.place_soon)[landed]),
        **stance_metrics(landings),
        "second_takeoff_rate": mean((landings.takeoffs > 0)[np.isfinite(landings.touchdown).all(axis=-1)]),
        at_rest: mean((landings.rest_speed < REST_SPEED)[landed]),
        "mean_landing_tilt_deg": mean(np.degrees(landings.tilt[landed])),
        "fall_rate": mean(np.isin(landings.ends, FALLS)[begun]),
        "miss_rate": mean((landings.outcomes == MISSED)[begun]),
        "early_rate": mean(landings.early[begun]),
        CAME_APART: int(landings.broken.sum()),
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


def random_headings(count: int, seed: int) -> np.ndarray:
    """Return headings (count,) [rad] over the full circle."""
    return np.random.default_rng(seed).uniform(-math.pi, math.pi, count)


@dataclass(frozen=True)
class PlaceFlags(JumpFlags):
    """Jumps to places from standing still."""

    goal_x: Place = (0.3, 1.5)
    """[m] Smallest and largest distance of the goal ahead; goals are evenly spaced."""
    goal_y: Place = (0.0, 0.0)
    """[m] Smallest and largest distance of the goal to the left; goals are drawn."""
    heading: Literal["any"] | float = "any"
    """[deg] Heading of all robots, or any: drawn from the full circle."""

    def __post_init__(self) -> None:
        """Raises InputError: a setting is out of range."""
        super().__post_init__()
        for name in ("goal_x", "goal_y"):
            low, high = getattr(self, name)
            if not -10.0 < low <= high < 10.0:
                raise InputError(f"{name} must be in (-10, 10) m and rise, got {low}, {high}")
        if self.heading != "any" and not math.isfinite(self.heading):
            raise InputError(f"heading must be finite or any, got {self.heading}")

    def log(self, task: TaskCfg, seed: int) -> PlaceLog:
        """Return single jumps with these goals and headings."""
        rng = np.random.default_rng(seed)
        x, y = np.linspace(*self.goal_x, self.num_jumps), rng.uniform(*self.goal_y, self.num_jumps)
        headings = random_headings(self.num_jumps, seed) if self.heading == "any" else math.radians(self.heading)
        return PlaceLog(np.stack([x, y], axis=1)[:, None], termination_names(task), headings)

    def metrics(self, log: PlaceLog) -> Metrics:
        """Return `landing_metrics`, with the range."""
        inside, (lower, upper) = within(np.linalg.norm(log.places, axis=-1), self.success_range), self.success_range
        return landing_metrics(log, inside) | {"range_lower_m": lower, "range_upper_m": upper}


@dataclass(frozen=True)
class PlaceGoals:
    """Jumps to places that are recorded."""

    goal: tyro.conf.UseAppendAction[tuple[Place, ...]] = ()
    """[m] Goal of a robot, ahead and to the left; give it once for each robot (default: three goals)."""
    next_goals: tyro.conf.UseAppendAction[tuple[Place, ...]] = ()
    """[m] Goal of all robots' next jump, ahead and to the left, a second after touchdown; give it once a jump."""
    unless_told: tyro.conf.Suppress[tuple[Place, ...]] = ((0.5, 0.0), (0.9, 0.0), (1.3, 0.0))
    """[m] Goals if there are none; flags that are given several times would be added to a default."""

    def __post_init__(self) -> None:
        """Raises InputError: a place is out of range, or their number."""
        for name in ("goal", "next_goals"):
            places = getattr(self, name)
            if len(places) > MAX_ROBOTS or not all(-10.0 < value < 10.0 for place in places for value in place):
                raise InputError(f"{name} takes up to {MAX_ROBOTS} places in (-10, 10) m, got {places}")

    @property
    def goals(self) -> tuple[Place, ...]:
        """[m] First goals, one a robot."""
        return self.goal or self.unless_told

    @property
    def length(self) -> float:
        """[s] Of the recording."""
        return SECONDS + SECONDS_MORE * len(self.next_goals)

    def log(self, task: TaskCfg) -> PlaceLog:
        """Return one row of jumps a robot."""
        return PlaceLog(np.array([[goal, *self.next_goals] for goal in self.goals]), termination_names(task))
