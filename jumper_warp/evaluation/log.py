"""An evaluation run: what every world is asked for, step by step, and what became of it.

One log follows one episode a world. `run_evaluation` is the loop; what is asked for and told differs between tasks.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from jumper_warp.envs.env import Env
from jumper_warp.tasks.cfg import TaskCfg
from jumper_warp.utils.errors import InputError

if TYPE_CHECKING:
    import torch

    from jumper_warp.evaluation.film import Film, Strip

SUCCESS = "success"
CAME_APART = "came_apart"
COLLIDED = "collided"
NO_END = "no_end"
"""Outcome of what was still under way at the end."""

Metrics = dict[str, float | int | None]


class EvaluationLog(ABC):
    """Asks every world for something, and keeps what became of it."""

    row = "jump"
    """What a row of `columns` is about, in a word."""
    spacing = 1.2
    """[m] Between robots that are drawn side by side."""
    count: int
    """Number of worlds."""
    seen: dict[str, np.ndarray]
    """What was seen of the environment last."""

    @property
    @abstractmethod
    def seconds(self) -> float:
        """[s] Simulated time after which what has not ended is a failure."""

    @abstractmethod
    def begin(self, env: Env) -> None:
        """Stand every world at its start."""

    @abstractmethod
    def update(self, arrays: dict[str, np.ndarray], step_dt: float) -> bool:
        """Take in a policy step; return whether everything has ended."""

    @abstractmethod
    def columns(self) -> dict[str, list]:
        """Return what to tell of every row, one list a quantity."""

    @abstractmethod
    def series(self, worlds: Sequence[int]) -> dict[str, float]:
        """Return what to draw of some worlds over time, `group/quantity [unit]` to its present value."""

    def goal_markers(self, worlds: Sequence[int]) -> np.ndarray | None:
        """Return places to mark in a picture [m], world frame, (worlds, places a world, 3), if there are any."""
        return None

    def notes(self, worlds: Sequence[int]) -> dict[str, Any]:
        """Return what to save with a recording of some worlds, as JSON can hold it."""
        return {}

    def filmstrip(self, film: Film) -> Strip | None:
        """Return the filmstrip that shows most of a film, if there is one."""
        return None

    def read_env(self, env: Env) -> dict[str, np.ndarray]:
        """Return what is to be known of every world after a policy step."""
        return env.task_arrays()

    def record_step(self, env: Env) -> bool:
        """Look at the environment after a policy step; return whether everything has ended."""
        self.seen = self.read_env(env)
        return self.update(self.seen, env.step_dt)


def run_evaluation(
    act: Callable[[torch.Tensor], torch.Tensor],
    env: Env,
    log: EvaluationLog,
    *,
    seconds: float | None = None,
    watch: Callable[[], object] | None = None,
    stop: bool = True,
) -> None:
    """Run one episode a world as the log commands, until all have ended.

    act: observations (num_envs, num_obs) to actions, such as `Policy.act`; seconds: simulated time at most (default:
    the log's); watch: called after every policy step; stop: False to continue to the end of the time.
    """
    log.begin(env)
    for _ in range(round((log.seconds if seconds is None else seconds) / env.step_dt)):
        env.step(act(env.obs))
        ended = log.record_step(env)
        if watch is not None:
            watch()
        if ended and stop:
            return


def success_index(terminations: Sequence[str]) -> int:
    """Return the place of SUCCESS among the names of terminations. Raises InputError: it is not there."""
    if SUCCESS not in terminations:
        raise InputError(f"this evaluation needs a termination {SUCCESS!r}, the task has {', '.join(terminations)}")
    return list(terminations).index(SUCCESS)


def with_terminations(task: TaskCfg, names: Sequence[str]) -> TaskCfg:
    """Return a task of whose terminations those with some names are left, judged in the order of the names."""
    terms = {term.name: term for term in task.terminations}
    return replace(task, terminations=tuple(terms[name] for name in names if name in terms))


def termination_names(task: TaskCfg) -> tuple[str, ...]:
    """Return the names of a task's terminations."""
    return tuple(term.name for term in task.terminations)


def within(values: np.ndarray, limits: tuple[float, float]) -> np.ndarray:
    """Return which values [m] are between limits, give or take half a millimetre for those that were evenly spaced."""
    return (values >= limits[0] - 5e-4) & (values <= limits[1] + 5e-4)


def mean(values: ArrayLike | Sequence[float | None]) -> float | None:
    """Return the mean of what is a number, None if nothing is."""
    numbers = np.asarray(values, dtype=float)
    numbers = numbers[~np.isnan(numbers)]
    return float(numbers.mean()) if len(numbers) else None


def largest(values: np.ndarray) -> float | None:
    """Return the largest of what is a number, None if nothing is."""
    values = values[~np.isnan(values)]
    return float(values.max()) if len(values) else None


def mean_and_max(name: str, values: np.ndarray) -> Metrics:
    """Return the mean and the largest of what is a number, as `mean_<name>` and `max_<name>`."""
    return {f"mean_{name}": mean(values), f"max_{name}": largest(values)}


def failures(outcomes: np.ndarray) -> Metrics:
    """Return how many failed rows ended in which way."""
    return {f"failed_by_{name}": int((outcomes == name).sum()) for name in sorted(set(outcomes))}


def finite(values: np.ndarray) -> list[float | None]:
    """Return values as JSON holds them, None where there is no number."""
    return [float(value) if np.isfinite(value) else None for value in values]
