"""Following jumps to places in the plane: where they land, and what becomes of the robot.

A jump is over once the robot has had a second to come to rest; the distance between base and goal then is its error. A
jump that fails before is measured where it failed. Whether the robot hopped or stepped to get there, is told apart.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from jumper_warp.evaluation.angles import wrapped, yaw_of
from jumper_warp.evaluation.film import Film, Strip, moments
from jumper_warp.evaluation.jumps import LANDED, REST_TIME, jump_commands
from jumper_warp.evaluation.log import (
    CAME_APART,
    NO_END,
    SUCCESS,
    EvaluationEnv,
    EvaluationLog,
    finite,
    success_index,
    with_ends,
)
from jumper_warp.evaluation.paws import TAKEOFF_SPEED, Paws, hopped, paw_arrays, stepped
from jumper_warp.kernels.jump import terminations
from jumper_warp.tasks.cfg import TaskCfg
from jumper_warp.tasks.terms import TerminationTerm
from jumper_warp.utils.errors import InputError

SUCCESS_TOLERANCE = 0.1
"""[m] A landed jump that ends this close to its goal succeeds."""
SOON = 0.3
"""[s] After touchdown, when the base is looked at as well."""
ENDS = ("came_apart", "low_base", "collided", "no_jump", SUCCESS)
"""Terminations of the task that end a jump here, in this order, so that no success hides a fall; the others only shape
the training."""
SHOWN_DISTANCE = 1.0
"""[m] The filmstrip shows the jump nearest to this."""
EYE_DISTANCE = 2.4
"""[m] From the jump's path to the eye."""
PICTURE = (400, 320)
"""[px]"""
FALLS = ("came_apart", "low_base", "collided")
MISSED = "missed"
"""Outcome of a jump that landed well, but elsewhere."""
EARLY = "early"
"""Outcome of a jump that began before the command."""
NOT_BEGUN = "not_begun"
"""Outcome of a jump that was due after one that failed."""


def for_evaluation(task: TaskCfg) -> TaskCfg:
    """Return a task with the terminations that count in an evaluation."""
    return with_ends(task, ENDS)


def ended_by_takeoff(task: TaskCfg) -> TaskCfg:
    """Return the same, and a second takeoff after landing ends the jump, as in the authors' configuration."""
    task = for_evaluation(task)
    takeoff = TerminationTerm(terminations.second_takeoff, speed=TAKEOFF_SPEED)
    return replace(task, terminations=(*task.terminations[:-1], takeoff, task.terminations[-1]))


@dataclass
class Landings(EvaluationLog):
    """What became of one row of jumps per world; arrays have shape (num_envs, jumps in a row), not a number before.

    The first jump goes to a place relative to start and heading, each other one relative to the base's place and yaw
    when it is commanded.
    """

    goals: np.ndarray
    """[m] (num_envs, jumps in a row, 2), ahead and to the left."""
    terminations: tuple[str, ...]
    """Names of the ends of an episode, SUCCESS among them."""
    headings: np.ndarray | float = 0.0
    """[rad] (num_envs,) or one for all."""
    delay: np.ndarray | float = 0.5
    """[s] Until the first jump is commanded; (num_envs,) or one for all."""
    rest: float = REST_TIME
    """[s] From touchdown until the jump is over, and the next one commanded."""
    current: np.ndarray = field(init=False)
    """(num_envs,) Number of the jump under way; that of jumps in a row after the end."""
    end: np.ndarray = field(init=False)
    """Index of the end in `terminations`, -1 before it."""
    place: np.ndarray = field(init=False)
    """[m] (..., 2) Base at the end, world."""
    target: np.ndarray = field(init=False)
    """[m] (..., 2) Where it should be, world."""
    yaw: np.ndarray = field(init=False)
    """[rad] Of the base at the end, from the jump's heading."""
    heading: np.ndarray = field(init=False)
    """[rad] Of the jump."""
    apex: np.ndarray = field(init=False)
    """[m] Largest base height."""
    tilt: np.ndarray = field(init=False)
    """[rad] Largest since touchdown."""
    rest_speed: np.ndarray = field(init=False)
    """[m/s] Of the base at the end of a landed jump; infinite otherwise."""
    touchdown: np.ndarray = field(init=False)
    """[m] (..., 2) Base at touchdown, world."""
    air_time: np.ndarray = field(init=False)
    """[s] Longest that no paw was on the ground after touchdown."""
    lift_time: np.ndarray = field(init=False)
    """[s] Longest that any paw was off the ground again after its own first contact since touchdown."""
    takeoffs: np.ndarray = field(init=False)
    """Number of times that the robot took off again after touchdown."""
    place_soon: np.ndarray = field(init=False)
    """[m] (..., 2) Base SOON after touchdown, world; not a number if the jump was over before."""
    early: np.ndarray = field(init=False)
    """Whether the jump began before the command."""

    spacing = 3.0

    def __post_init__(self) -> None:
        """Begin with no jump ended. Raises ValueError for goals of another shape."""
        self.goals = np.asarray(self.goals, dtype=float)
        if self.goals.ndim != 3 or self.goals.shape[2] != 2:
            raise InputError(f"goals must have shape (num_envs, jumps, 2), got {self.goals.shape}")
        shape = self.goals.shape[:2]
        self.current, self.end = np.zeros(shape[0], dtype=int), np.full(shape, -1)
        self.place, self.target, self.touchdown, self.place_soon = (np.full((*shape, 2), np.nan) for _ in range(4))
        self.air_time, self.lift_time = np.zeros(shape), np.zeros(shape)
        self.takeoffs, self._paws = np.zeros(shape, dtype=int), Paws(shape[0])
        self._success = success_index(self.terminations)
        self.yaw, self.heading, self.apex, self.tilt = (np.full(shape, np.nan) for _ in range(4))
        self.rest_speed, self.early = np.full(shape, np.inf), np.zeros(shape, dtype=bool)

    @property
    def seconds(self) -> float:
        """[s] In which a row has ended."""
        return longest(self.goals.shape[1], self.rest) + float(np.max(self.delay))

    def begin(self, env: EvaluationEnv) -> None:
        """Stand every world in the default pose with its first goal."""
        goals = np.zeros((env.num_envs, 3))
        goals[:, :2] = self.goals[:, 0]
        env.evaluation_reset(jump_commands(goals, self.delay, env.step_dt), self.headings)

    def look(self, env: EvaluationEnv) -> dict[str, np.ndarray]:
        """Return the state of every world's episode, which of its paws are on the ground, and how fast it rises."""
        return env.task_arrays() | paw_arrays(env)

    def follow(self, env: EvaluationEnv) -> bool:
        """Look at the environment after a policy step, and command the jumps that are due."""
        before = self.current.copy()
        ended = super().follow(env)
        due = (self.current > before) & (self.current < self.goals.shape[1])
        if due.any():
            goals = np.zeros((env.num_envs, 3), dtype=np.float32)
            goals[due, :2] = self.goals[due, self.current[due]]
            env.command(goals, due)
        return ended

    def update(self, arrays: dict[str, np.ndarray], step_dt: float) -> bool:
        """Take in a policy step; return whether all jumps have ended."""
        count = self.goals.shape[1]
        row = np.flatnonzero(self.current < count)
        now = {name: values[row] for name, values in arrays.items()}
        at = (row, self.current[row])
        self.place[at], self.target[at] = now["base_pos"][:, :2], now["goal"][:, :2]
        self.heading[at] = now["heading"]
        self.yaw[at] = wrapped(yaw_of(now["base_quat"]) - now["heading"])
        self.apex[at], self.tilt[at] = now["max_height"], now["peak_tilt"]
        self.early[at] |= (now["took_off"] == 1) & (now["steps"] < now["command_step"])
        landed = now["phase"] == LANDED
        first, soon = landed & (now["touched_down"] == 1), landed & (now["phase_steps"] == round(SOON / step_dt))
        self.touchdown[row[first], self.current[row[first]]] = now["base_pos"][first, :2]
        self.place_soon[row[soon], self.current[row[soon]]] = now["base_pos"][soon, :2]
        lifted = self._paws.update(row, landed, now["paws_down"], now["up"], step_dt)
        self.air_time[at] = np.maximum(self.air_time[at], lifted.aloft)
        self.lift_time[at] = np.maximum(self.lift_time[at], lifted.paw)
        self.takeoffs[at] += lifted.takeoff
        failed = (now["ending"] >= 0) & (now["ending"] != self._success)
        rested = ~failed & landed & (now["phase_steps"] >= round(self.rest / step_dt))
        speed = np.linalg.norm(now["base_vel"], axis=1)
        self.rest_speed[at] = np.where(rested, speed, np.inf)
        self.end[at] = np.where(failed, now["ending"], np.where(rested, self._success, -1))
        self.current[row[rested]] += 1
        self.current[row[failed]] = count
        return bool((self.current >= count).all())

    @property
    def offset(self) -> np.ndarray:
        """[m] (..., 2) From goal to base at the end, ahead and to the left of the jump's heading."""
        turn = -self.heading[..., None]
        x, y = np.moveaxis(self.place - self.target, -1, 0)
        cos, sin = np.cos(turn[..., 0]), np.sin(turn[..., 0])
        return np.stack([cos * x - sin * y, sin * x + cos * y], axis=-1)

    @property
    def landing(self) -> np.ndarray:
        """[m] (..., 2) Base at the end, where the goals are measured."""
        return self.goals + self.offset

    @property
    def error(self) -> np.ndarray:
        """[m] Distance of the base from the goal at the end; not a number where the simulation came apart."""
        broken = (self.ends == CAME_APART) | ~np.isfinite(self.place).all(axis=-1)
        return np.where(broken, np.nan, np.linalg.norm(self.place - self.target, axis=-1))

    @property
    def ends(self) -> np.ndarray:
        """Name of each jump's end, whether or not it met its goal."""
        names = np.array([*self.terminations, NO_END], dtype=object)[self.end]
        return np.where(np.isnan(self.heading), NOT_BEGUN, names)

    @property
    def landed(self) -> np.ndarray:
        """Whether the robot came down on its paws and stayed there, wherever it was."""
        return self.end == self._success

    @property
    def success(self) -> np.ndarray:
        """Whether the jump, begun on command, was landed near its goal."""
        near = np.nan_to_num(self.error, nan=np.inf) <= SUCCESS_TOLERANCE
        return self.landed & near & ~self.early

    @property
    def single(self) -> np.ndarray:
        """Whether the jump succeeded without another one after touchdown."""
        return self.success & ~self.hopped

    @property
    def hopped(self) -> np.ndarray:
        """Whether the robot jumped again after touchdown."""
        return hopped(self.air_time)

    @property
    def step_free(self) -> np.ndarray:
        """Whether the jump succeeded without a step after touchdown, and so without another jump."""
        return self.success & ~self.stepped

    @property
    def stepped(self) -> np.ndarray:
        """Whether any paw that had come down was off the ground again for HOP_TIME or longer."""
        return stepped(self.lift_time)

    @property
    def touched_down(self) -> np.ndarray:
        """Whether a paw came down after the takeoff."""
        return np.isfinite(self.touchdown).all(axis=-1)

    @property
    def still(self) -> np.ndarray:
        """Whether the robot landed, wherever it was, and lifted no paw again for HOP_TIME or longer."""
        return self.landed & ~self.stepped

    @property
    def took_off_again(self) -> np.ndarray:
        """Whether the robot took off again after touchdown: upward at TAKEOFF_SPEED with no paw down."""
        return self.takeoffs > 0

    @property
    def touchdown_error(self) -> np.ndarray:
        """[m] Distance of the base from the goal at touchdown; not a number without one."""
        return np.linalg.norm(self.touchdown - self.target, axis=-1)

    @property
    def error_soon(self) -> np.ndarray:
        """[m] Distance of the base from the goal SOON after touchdown; not a number if the jump was over before."""
        return np.linalg.norm(self.place_soon - self.target, axis=-1)

    @property
    def outcomes(self) -> np.ndarray:
        """Name of each jump's end."""
        missed = np.where(self.landed & ~self.success, np.where(self.early, EARLY, MISSED), self.ends)
        return np.where(self.success, SUCCESS, missed)

    def columns(self) -> dict[str, list]:
        """Return goals, headings, landings and errors, and the ends; row after row."""
        goals, landing = self.goals.reshape(-1, 2), self.landing.reshape(-1, 2)
        numbers = {
            "goal_x_m": goals[:, 0],
            "goal_y_m": goals[:, 1],
            "heading_deg": np.degrees(self.heading).ravel(),
            "landing_x_m": landing[:, 0],
            "landing_y_m": landing[:, 1],
            "error_m": self.error.ravel(),
        }
        ends = {"end": self.outcomes.ravel().tolist()}
        return {name: finite(values) for name, values in numbers.items()} | ends

    def series(self, worlds: Sequence[int]) -> dict[str, float]:
        """Return the base's height and its distance from the goal of the moment [m]."""
        pos, goal = self.seen["base_pos"], self.seen["goal"]
        series = {}
        for world in worlds:
            series[f"height/base of {world} [m]"] = pos[world, 2]
            series[f"distance/goal of {world} [m]"] = np.linalg.norm(pos[world, :2] - goal[world, :2])
        return series

    def marks(self, worlds: Sequence[int]) -> np.ndarray:
        """Return the goals that were commanded [m], world frame, (worlds, jumps in a row, 3), z = 0."""
        target = self.target[list(worlds)]
        return np.concatenate([target, np.zeros_like(target[..., :1])], axis=-1)

    def notes(self, worlds: Sequence[int]) -> dict[str, Any]:
        """Return the goals [m]."""
        return {"goals_m": self.goals[list(worlds)].tolist()}

    def strip(self, film: Film) -> Strip:
        """Return pictures of the jump, or row of jumps, that begins with about SHOWN_DISTANCE."""
        distance = np.linalg.norm(self.goals[film.worlds, 0], axis=1)
        index = int(np.argmin(np.abs(distance - SHOWN_DISTANCE)))
        base = film.base(index)
        if self.goals.shape[1] == 1:
            delay = np.broadcast_to(self.delay, film.env.num_envs)[film.worlds[index]]
            frames = moments(base[:, 2], round(delay / film.env.step_dt) - 1)
        else:
            frames = np.linspace(0, len(base) - 1, 9).round().astype(int).tolist()
        ends = self.place[film.worlds[index]]
        eye, target = beside(base[0, :2], ends[np.isfinite(ends[:, 0])][-1])
        captions = [f"{(frame + 1) * film.env.step_dt:.2f} s" for frame in frames]
        return Strip(index, frames, captions, eye, target, PICTURE)


def longest(jumps: int, rest: float = REST_TIME) -> float:
    """Return how long [s] jumps in a row may take: waiting, squatting and flying at most 3.5 s, and resting."""
    return 1.0 + jumps * (3.5 + rest)


def beside(start: np.ndarray, end: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return an eye beside the way from start to end (2,), and the point that it looks at, (3,); [m], world frame."""
    way = end - start
    length = float(np.linalg.norm(way))
    ahead = way / length if length > 1.0e-3 else np.array([1.0, 0.0])
    middle = np.append(start + 0.5 * way, 0.4)
    back = EYE_DISTANCE * max(1.0, length / 1.5)
    return middle + np.array([back * ahead[1], -back * ahead[0], 0.35]), middle
