"""Evaluation loop `run_evaluation`, and the base class of the logs that set commands and record outcomes."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from jumper_warp.utils.errors import InputError
from jumper_warp.utils.files import Json
from jumper_warp.utils.metrics import Metrics, rate
from jumper_warp.utils.progress import phase

if TYPE_CHECKING:
    import torch

    from jumper_warp.envs.env import Env

SUCCESS = "success"  # Outcomes, also names of terminations
DIVERGED = "diverged"  # The state of the simulation is not finite or beyond the speed limits
COLLIDED = "collided"  # A link other than a paw touched something
FALLS = (DIVERGED, "low_base", "tilted", COLLIDED)  # Outcomes that count as falls
NO_END = "no_end"  # Outcome of an episode that had not ended within the simulated time


class EvaluationLog(ABC):
    """Base class of logs that set the commands of one episode per world and record outcomes, see `run_evaluation`."""

    row_name = "jump"  # Noun for a trial; names the recording
    main_columns: Sequence[str] = ()  # Names of the columns in the summary of `jumper play`; empty: all
    main_metrics: Sequence[str] = ()  # Keys of the task's own metrics, for the summary of `jumper evaluate`
    spacing = 1.2  # [m] Distance between robots that a recording shows side by side
    count: int  # Number of worlds
    arrays: dict[str, np.ndarray]  # Result of the last `read_env`, one row per world

    @property
    @abstractmethod
    def seconds(self) -> float:
        """Maximum simulated time [s]; an episode that has not ended by then has the outcome NO_END."""

    @abstractmethod
    def begin(self, env: Env) -> None:
        """Reset every world and set its first command."""

    @abstractmethod
    def update(self, arrays: dict[str, np.ndarray], step_dt: float) -> bool:
        """Record a policy step from the arrays of `read_env`; return whether all episodes have ended."""

    @abstractmethod
    def columns(self) -> dict[str, list]:
        """Return the values of all trials as columns by name: lists of equal length, each of one type or None."""

    @abstractmethod
    def series(self) -> dict[str, np.ndarray]:
        """Return the current values to plot of all worlds, (num_envs,) each, by name `group/quantity, {} [unit]`.

        {} stands for the name of a world, see `named`.
        """

    def states(self) -> dict[str, np.ndarray]:
        """Return current states of all worlds as texts, (num_envs,), such as phases of jumps, by name `quantity/{}`.

        {} stands for the name of a world, see `named`.
        """
        return {}

    def marks(self) -> dict[str, np.ndarray]:
        """Return the goals, heights and commands that recordings draw, for all worlds, by name.

        `goals` [m] (num_envs, goals per world, 3), world frame; `heights` [m] (num_envs,), commanded, of the base at
        the apex; `commands` (num_envs, 3), current velocities ahead, left [m/s], about z [rad/s], body axes.
        """
        return {}

    def all_commands(self) -> np.ndarray | None:
        """Return all worlds' commands (..., 3), to compare with ranges of training; None: there are no ranges."""
        return None

    def labels(self, worlds: Sequence[int]) -> list[str]:
        """Return titles of some worlds for recordings and pictures, such as their goals in metres."""
        return [f"{self.row_name} {world + 1}" for world in worlds]

    def names(self, worlds: Sequence[int]) -> list[str]:
        """Return distinct names of some worlds: their labels, with the world's number if a label is repeated."""
        labels = self.labels(worlds)
        pairs = zip(labels, worlds, strict=True)
        return [
            label if labels.count(label) == 1 else f"{label}, {self.row_name} {world + 1}" for label, world in pairs
        ]

    def named(self, values: Mapping[str, Any], worlds: Sequence[int]) -> Json:
        """Select some worlds' entries of `series` or `states`, with the world's name in each key in place of {}.

        A recording has one flat dict for all its worlds, so each key names its world.
        """
        names = list(zip(self.names(worlds), worlds, strict=True))
        return {key.format(name): values[key][world] for name, world in names for key in values}

    def notes(self, worlds: Sequence[int]) -> Json:
        """Return the metadata, JSON values by key, that a recording of some worlds (indices) saves."""
        return {}

    def read_env(self, env: Env) -> dict[str, np.ndarray]:
        """Return the arrays that `update` needs by name, each (num_envs, ...); by default `Env.task_arrays`."""
        return env.task_arrays()

    def record_step(self, env: Env) -> bool:
        """Read the environment after a policy step and record it; return whether all episodes have ended."""
        self.arrays = self.read_env(env)
        return self.update(self.arrays, env.step_dt)


def run_evaluation(
    act: Callable[[torch.Tensor], torch.Tensor],
    env: Env,
    log: EvaluationLog,
    *,
    seconds: float | None = None,
    on_begin: Callable[[], object] | None = None,
    on_step: Callable[[], object] | None = None,
    stop: bool = True,
) -> None:
    """Run one episode per world with the commands of the log, until all have ended.

    act: observations (num_envs, num_obs) to actions (num_envs, 12), such as `Policy.act`; seconds: maximum simulated
    time (default: the log's); on_begin: called before the first policy step; on_step: called after every one; stop:
    False to continue to the end of the time.
    """
    log.begin(env)
    if on_begin is not None:
        on_begin()
    steps = round((log.seconds if seconds is None else seconds) / env.step_dt)
    with phase(f"simulating {log.count} {log.row_name}{'s' * (log.count > 1)}", steps) as advance:
        for _ in range(steps):
            env.step(act(env.obs))
            ended = log.record_step(env)
            if on_step is not None:
                on_step()
            if ended and stop:
                return
            advance()


def check(condition: bool, message: str) -> None:
    """Raise InputError with a message unless a condition holds."""
    if not condition:
        raise InputError(message)


def within(values: np.ndarray, limits: tuple[float, float]) -> np.ndarray:
    """Return whether each value [m] is between two limits, bool of the same shape, with tolerance for rounding."""
    return (values >= limits[0] - 5e-4) & (values <= limits[1] + 5e-4)  # [m]


def ended_by(outcomes: np.ndarray, over: str) -> Metrics:
    """Return the rate of each outcome that occurs, as `ended_by_<outcome>_rate`; over: what the trials are."""
    return {f"ended_by_{name}_rate": rate(outcomes == name, over) for name in sorted(set(outcomes.ravel()))}


def listed(columns: Mapping[str, np.ndarray]) -> dict[str, list]:
    """Convert arrays (n,) by name to lists that JSON can hold, with None for NaN and infinity."""
    lists = {name: values.tolist() for name, values in columns.items()}
    return {
        name: [None if isinstance(value, float) and not np.isfinite(value) else value for value in values]
        for name, values in lists.items()
    }
