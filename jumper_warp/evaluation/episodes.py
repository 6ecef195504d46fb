"""Episodes of any task: how long they last, how they end, and where the base goes."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from jumper_warp.envs.env import Env
from jumper_warp.evaluation.log import NO_END, EvaluationLog, Metrics, finite, mean
from jumper_warp.tasks.cfg import TaskCfg
from jumper_warp.tasks.commands import layout_of
from jumper_warp.utils.errors import InputError

MOST_SECONDS = 600.0
MOST_NUMBERS = 4
"""In a command."""


@dataclass
class Episodes(EvaluationLog):
    """What became of one episode per world; each array has shape (num_envs, ...). Nothing changes after its end."""

    commands: np.ndarray
    """One row a world, of what the task's command takes."""
    task: TaskCfg
    seconds: float = 10.0
    """Simulated time at most."""
    end: np.ndarray = field(init=False)
    """Index of the termination, -1 before it."""
    length: np.ndarray = field(init=False)
    """[s] Of the episode."""
    start: np.ndarray = field(init=False)
    """[m] (..., 3) Base at the start, world."""
    place: np.ndarray = field(init=False)
    """[m] (..., 3) Base at the end, world."""

    row = "episode"
    spacing = 2.0

    def __post_init__(self) -> None:
        """Begin with no episode ended."""
        self.count = count = len(self.commands)
        self.end, self.length = np.full(count, -1), np.zeros(count)
        self.start, self.place = (np.full((count, 3), np.nan) for _ in range(2))
        self._height_sum, self._steps = np.zeros(count), np.zeros(count, dtype=int)

    def begin(self, env: Env) -> None:
        """Stand every world in the default pose with its command."""
        env.evaluation_reset(self.commands)
        self.start = env.task_arrays()["base_pos"].copy()

    def update(self, arrays: dict[str, np.ndarray], step_dt: float) -> bool:
        """Take in a policy step; return whether all episodes have ended."""
        running = self.end < 0
        self.place[running] = arrays["base_pos"][running]
        self._height_sum[running] += arrays["base_pos"][running, 2]
        self._steps[running] += 1
        self.length[running] += step_dt
        ended = running & (arrays["ending"] >= 0)
        self.end[ended] = arrays["ending"][ended]
        return bool((self.end >= 0).all())

    @property
    def mean_height(self) -> np.ndarray:
        """[m] Of the base over the episode; not a number before the first step."""
        return np.where(self._steps > 0, self._height_sum / np.maximum(self._steps, 1), np.nan)

    @property
    def moved(self) -> np.ndarray:
        """[m] (..., 2) From start to end of the base, world."""
        return (self.place - self.start)[:, :2]

    @property
    def outcomes(self) -> np.ndarray:
        """Name of each episode's end."""
        return np.array([*(term.name for term in self.task.terminations), NO_END])[self.end]

    def of_kind(self, option: str) -> np.ndarray:
        """Return which episodes ended by a termination with an option, such as `success` or `time_out`."""
        return np.array([*(bool(term.options[option]) for term in self.task.terminations), False])[self.end]

    def columns(self) -> dict[str, list]:
        """Return commands, lengths, heights and places [m] and the ends."""
        numbers = {f"command_{i}": self.commands[:, i] for i in range(self.commands.shape[1])}
        numbers |= {"length_s": self.length, "mean_base_height_m": self.mean_height}
        numbers |= {f"base_{axis}_m": self.place[:, i] for i, axis in enumerate("xyz")}
        return {name: finite(values) for name, values in numbers.items()} | {"end": self.outcomes.tolist()}

    def series(self, worlds: Sequence[int]) -> dict[str, float]:
        """Return the base's height and its distance from the start [m]."""
        series, pos = {}, self.seen["base_pos"]
        for world in worlds:
            series[f"height/base of {world} [m]"] = pos[world, 2]
            series[f"distance/start of {world} [m]"] = np.linalg.norm((pos - self.start)[world, :2])
        return series

    def notes(self, worlds: Sequence[int]) -> dict[str, Any]:
        """Return the commands."""
        return {"commands": self.commands[list(worlds)].tolist()}


def episode_metrics(episodes: Episodes) -> Metrics:
    """Return the metrics of episodes: shares of all, means over all, and how many ended in which way."""
    outcomes, still = episodes.outcomes, episodes.end < 0
    success, timed_out = episodes.of_kind("success"), episodes.of_kind("time_out")
    distance = np.linalg.norm(episodes.moved, axis=1)
    metrics: Metrics = {
        "episodes": len(outcomes),
        "mean_episode_s": mean(episodes.length),
        "success_rate": float(success.mean()),
        "failure_rate": float((~still & ~success & ~timed_out).mean()),
        "no_end_rate": float(still.mean()),
        "mean_base_height_m": mean(np.array(finite(episodes.mean_height), dtype=float)),
        "mean_base_height_at_the_end_m": mean(np.array(finite(episodes.place[:, 2]), dtype=float)),
        "mean_distance_from_start_m": mean(np.array(finite(distance), dtype=float)),
        "mean_moved_x_m": mean(np.array(finite(episodes.moved[:, 0]), dtype=float)),
        "mean_moved_y_m": mean(np.array(finite(episodes.moved[:, 1]), dtype=float)),
    }
    return metrics | {f"ended_by_{name}": int((outcomes == name).sum()) for name in sorted(set(outcomes))}


def check_episodes(count: int, command: tuple[float, ...], seconds: float) -> None:
    """Raise InputError unless this can be asked of a number of worlds."""
    if count < 1:
        raise InputError(f"num_episodes must be at least 1, got {count}")
    if len(command) > MOST_NUMBERS or not all(math.isfinite(value) for value in command):
        raise InputError(f"command takes up to {MOST_NUMBERS} finite numbers, got {command}")
    if not 0.0 < seconds <= MOST_SECONDS:
        raise InputError(f"seconds must be in (0, {MOST_SECONDS:g}], got {seconds}")


def filled(command: tuple[float, ...], count: int, task: TaskCfg) -> np.ndarray:
    """Return commands of worlds that are all asked for the same, one a row; numbers that are left out are 0."""
    missing = max(layout_of(task).counts[-1] - len(command), 0)
    return np.tile(np.pad(np.array(command, dtype=float), (0, missing)), (count, 1))


@dataclass(frozen=True)
class EpisodeFlags:
    """Episodes from standing still."""

    num_episodes: int = 200
    """Number of episodes."""
    command: tuple[float, ...] = ()
    """Up to four numbers, as the task's command takes them; those left out are 0."""
    seconds: float = 10.0
    """[s] Largest length of an episode."""

    def __post_init__(self) -> None:
        """Raises InputError: a setting is out of range."""
        check_episodes(self.num_episodes, self.command, self.seconds)

    def log(self, task: TaskCfg, seed: int) -> Episodes:
        """Return episodes with this command."""
        return Episodes(filled(self.command, self.num_episodes, task), task, self.seconds)

    def metrics(self, log: Episodes) -> Metrics:
        """Return `episode_metrics`."""
        return episode_metrics(log)


@dataclass(frozen=True)
class EpisodeGoals:
    """An episode that is recorded."""

    command: tuple[float, ...] = ()
    """Up to four numbers, as the task's command takes them; those left out are 0."""

    length = 10.0

    def __post_init__(self) -> None:
        """Raises InputError: a setting is out of range."""
        check_episodes(1, self.command, self.length)

    def log(self, task: TaskCfg) -> Episodes:
        """Return one robot's episode."""
        return Episodes(filled(self.command, 1, task), task, self.length)
