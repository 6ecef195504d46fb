"""Evaluation of any task by single episodes: log and metrics of length, termination and base position."""

from __future__ import annotations

import re
import sys
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

from jumper_warp.evaluation.log import NO_END, EvaluationLog, check, ended_by, listed
from jumper_warp.tasks.cfg import TaskCfg
from jumper_warp.utils.checks import FLOAT32_MAX
from jumper_warp.utils.files import Json
from jumper_warp.utils.metrics import Metrics, largest, mean, rate

if TYPE_CHECKING:
    from jumper_warp.envs.env import Env

MAX_SECONDS = 600.0  # [s] Maximum length of an episode
MAX_COMMAND_SIZE = 4  # Maximum number of values in a command
STATISTICS = {"mean": mean, "max": largest, "rate": rate}  # By `EpisodeMetric.statistic`


@dataclass
class EpisodeLog(EvaluationLog):
    """Log of one episode per world of any task; entries of a world do not change after its episode's end."""

    commands: np.ndarray
    """(num_envs, n) Command of each world, as in the task's `Command`; n = 0: the task samples commands."""
    task: TaskCfg
    seconds: float = 10.0  # [s] Maximum simulated time
    end: np.ndarray = field(init=False)  # (num_envs,) Index of the termination that ended the episode, -1 while it runs
    length: np.ndarray = field(init=False)  # [s] (num_envs,) Length of the episode
    start_position: np.ndarray = field(init=False)  # [m] (num_envs, 3) Base position at the start, world frame
    end_position: np.ndarray = field(init=False)  # [m] (num_envs, 3) Base position at the end, world frame

    row_name = "episode"  # Noun for a trial, see `EvaluationLog`
    spacing = 2.0  # [m] Distance between robots that a recording shows side by side

    def __post_init__(self) -> None:
        """Allocate results of one episode per world, NaN or -1 until they are known."""
        self.count = count = len(self.commands)
        self.end = np.full(count, -1)
        self.length = np.zeros(count)
        self.start_position, self.end_position = (np.full((count, 3), np.nan) for _ in range(2))
        self._height_sum = np.zeros(count)
        self._steps = np.zeros(count, dtype=int)
        self._start: dict[str, np.ndarray] = {}  # Sampled numbers of the task's state at the start, (num_envs,) each
        own: Any = self.task.evaluation  # an `EpisodeEvaluation`
        self.metrics, self.goal_marker = own.metrics, own.goal_marker
        self.main_metrics = [metric.key for metric in own.metrics]
        self.state: dict[str, np.ndarray] = {}  # Fields of the task's state, (num_envs, ...), that `own` names
        self.identical = count > 1  # Whether all worlds have been in equal states so far

    def begin(self, env: Env) -> None:
        """Reset every world to the default pose with its command or, without commands, to a start state of training."""
        if self.commands.shape[1]:
            env.evaluation_reset(self.commands)
        else:
            # past the last curriculum level, for which a reset samples one of all levels, see `make_reset_kernel`
            env.episodes.level.fill_(len(self.task.levels))
            env.reset()
        arrays = env.task_arrays()
        names = [metric.field for metric in self.metrics] + [self.goal_marker] * bool(self.goal_marker)
        self.state = {name: arrays[name].copy() for name in names}
        self.start_position = arrays["base_pos"].copy()
        self.identical &= rows_are_equal(arrays)
        if self.count == 1 or not self.commands.shape[1]:
            self._start = sampled_numbers(arrays)

    def update(self, arrays: dict[str, np.ndarray], step_dt: float) -> bool:
        """Record a policy step from the arrays of `read_env`; return whether all episodes have ended."""
        self.identical = self.identical and rows_are_equal(arrays)
        running = self.end < 0
        self.end_position[running] = arrays["base_pos"][running]
        for name, values in self.state.items():
            values[running] = arrays[name][running]
        self._height_sum[running] += arrays["base_pos"][running, 2]
        self._steps[running] += 1
        self.length[running] += step_dt
        ended = running & (arrays["termination"] >= 0)
        self.end[ended] = arrays["termination"][ended]
        return bool((self.end >= 0).all())

    @property
    def mean_height(self) -> np.ndarray:
        """Mean base height over the episode [m], (num_envs,); NaN before the first step."""
        return np.where(self._steps > 0, self._height_sum / np.maximum(self._steps, 1), np.nan)

    @property
    def displacement(self) -> np.ndarray:
        """Horizontal displacement of the base from start to end [m], world frame, (num_envs, 2)."""
        return (self.end_position - self.start_position)[:, :2]

    @property
    def outcomes(self) -> np.ndarray:
        """Name of the termination of each episode, (num_envs,); NO_END if it has not ended."""
        return np.array([*self.task.termination_names, NO_END])[self.end]

    def ended_with(self, option: str) -> np.ndarray:
        """Return whether each episode ended by a termination with option `success` or `time_out` set, (num_envs,)."""
        return np.array([*(bool(term.options[option]) for term in self.task.terminations), False])[self.end]

    def columns(self) -> dict[str, list]:
        """Return one value per episode by name: command, length, mean base height, final base position, outcome.

        Keys: command_<label>, length_s, mean_base_height_m, base_<axis>_m, fields of the task's metrics, end (outcome);
        without commands or of a single robot also start_<field>, each number of the state that the reset sampled.
        """
        columns = dict(zip(command_columns(self.task), self.commands.T, strict=False)) | self._start
        columns |= {"length_s": self.length, "mean_base_height_m": self.mean_height}
        columns |= {f"base_{axis}_m": self.end_position[:, i] for i, axis in enumerate("xyz")}
        columns |= {metric.field: self.state[metric.field] for metric in self.metrics}
        return listed(columns | {"end": self.outcomes})

    def marks(self) -> dict[str, np.ndarray]:
        """Return the goals or heights that the task's `goal_marker` names, those of the end after an episode."""
        if not self.goal_marker:
            return {}
        goal = self.state[self.goal_marker]
        return {"heights": goal} if goal.ndim == 1 else {"goals": goal[:, None]}

    def series(self) -> dict[str, np.ndarray]:
        """Return values to plot: base height and horizontal distance from the start [m] of all worlds."""
        pos = self.arrays["base_pos"]
        distance = np.linalg.norm((pos - self.start_position)[:, :2], axis=1)
        series = {"height/base, {} [m]": pos[:, 2], "distance/from start, {} [m]": distance}
        for label, values in zip(command_labels(self.task), self.commands.T, strict=False):
            name, _, unit = label.partition(" [")
            series[f"command/command {name}, {{}} [{unit or '1]'}"] = values
        return series

    def labels(self, worlds: Sequence[int]) -> list[str]:
        """Return titles of some worlds, such as "episode 1, x 0.6 m, y 0 m", or "episode 1, command 0.6 0"."""
        titles = super().labels(worlds)
        if not self.commands.shape[1]:
            return titles
        commands = [command_text(self.task, self.commands[world]) for world in worlds]
        return [f"{title}, {command}" for title, command in zip(titles, commands, strict=True)]

    def notes(self, worlds: Sequence[int]) -> Json:
        """Return metadata of a recording: the commands of some worlds, key `commands`, a list of rows."""
        return {"commands": self.commands[list(worlds)].tolist()}


def rows_are_equal(arrays: dict[str, np.ndarray]) -> bool:
    """Return whether all rows of each array are equal within rounding, NaN included."""
    numbers = [np.asarray(values, dtype=float) for values in arrays.values()]
    return all(np.allclose(each, each[:1], rtol=1e-6, atol=1e-6, equal_nan=True) for each in numbers)


def command_columns(task: TaskCfg) -> list[str]:
    """Return the names of the values of a task's command as columns, such as `command_x_m`; `command_0` if unnamed."""
    words = [re.sub(r"\W+", "_", label.removesuffix(" [1]")).strip("_") for label in task.command.labels]
    return [f"command_{word}" for word in words or range(MAX_COMMAND_SIZE)]


def command_labels(task: TaskCfg) -> tuple[str, ...]:
    """Return the labels of the values of a task's command, such as `x [m]`; numbers if they have none."""
    return task.command.labels or tuple(map(str, range(MAX_COMMAND_SIZE)))


def command_text(task: TaskCfg, command: np.ndarray) -> str:
    """Return a command (n,) in words, such as "x 0.6 m, y 0 m", or as "command 0.6 0" if its values have no names."""
    values = [f"{value:g}" for value in command]
    pairs = zip(task.command.labels, values, strict=False)
    words = [label[:-1].replace("[", f"{value} ").removesuffix(" 1").replace("/", " per ") for label, value in pairs]
    return ", ".join(words) or " ".join(["command", *values])


def sampled_numbers(arrays: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Return the floats of a task's state that differ between worlds, as columns (num_envs,) named `start_<field>`.

    Entry i of a vector is `start_<field>_<i>`; fields `base_*` are left out. Of a single world, fields that are not 0.
    arrays: of `Env.task_arrays`.
    """
    columns = {}
    for name, values in arrays.items():
        constant = rows_are_equal({name: values}) if len(values) > 1 else not values.any()
        if name.startswith("base_") or values.dtype.kind != "f" or values.ndim > 2 or constant:
            continue
        parts = {f"_{i}": values[:, i] for i in range(values.shape[1])} if values.ndim == 2 else {"": values}
        columns |= {f"start_{name}{end}": part.copy() for end, part in parts.items()}
    return columns


def episode_metrics(episodes: EpisodeLog, count: int | None = None) -> Metrics:
    """Return rates of outcomes, and mean length, base height and displacement, of a log of episodes.

    `ended_by_<outcome>_rate` is the rate of a termination. count: number of episodes to measure (default: all).
    """
    running = episodes.end[:count] < 0
    over = "episodes"
    displacement = episodes.displacement[:count]
    success, timed_out = (episodes.ended_with(option)[:count] for option in ("success", "time_out"))
    return {
        "success_termination_rate": rate(success, over),
        "failure_termination_rate": rate(~running & ~success & ~timed_out, over),
        **ended_by(episodes.outcomes[:count], over),
        "length_mean_s": mean(episodes.length[:count], over),
        "base_height_mean_m": mean(episodes.mean_height[:count], over),
        "base_height_at_end_mean_m": mean(episodes.end_position[:count, 2], over),
        "distance_from_start_mean_m": mean(np.linalg.norm(displacement, axis=1), over),
        "moved_x_signed_mean_m": mean(displacement[:, 0], over),
        "moved_y_signed_mean_m": mean(displacement[:, 1], over),
    } | {m.key: STATISTICS[m.statistic](episodes.state[m.field][:count], over) for m in episodes.metrics}


def check_episodes(count: int, command: tuple[float, ...], seconds: float) -> None:
    """Raise InputError unless number of episodes, command and length [s] are within their limits."""
    check(count >= 1, f"num_episodes must be at least 1, got {count}")
    fits = len(command) <= MAX_COMMAND_SIZE and all(abs(value) <= FLOAT32_MAX for value in command)
    check(fits, f"command takes up to {MAX_COMMAND_SIZE} finite numbers, got {command}")
    check(0.02 <= seconds <= MAX_SECONDS, f"seconds must be in [0.02, {MAX_SECONDS:g}], got {seconds}")


def tile_command(command: tuple[float, ...], count: int, task: TaskCfg) -> np.ndarray:
    """Return a command as one row per world, (count, n), with zeros for numbers that it leaves out.

    An empty command stays empty: (count, 0).
    """
    if not command:
        return np.zeros((count, 0))
    missing = max(task.command.counts[0] - len(command), 0)
    return np.tile(np.pad(np.array(command, dtype=float), (0, missing)), (count, 1))


@dataclass(frozen=True)
class EpisodeFlags:
    """Flags of `jumper evaluate` for episodes that start as in training or, with a command, in the default pose."""

    num_episodes: int = 200  # Number of episodes
    command: tuple[float, ...] = ()
    """Up to four values of the task's command; omitted ones are 0 (default: the task's reset samples each command)."""
    seconds: float = 10.0  # [s] Maximum length of an episode

    def __post_init__(self) -> None:
        """Raise InputError for a number of episodes, command or duration out of range."""
        check_episodes(self.num_episodes, self.command, self.seconds)

    def log(self, task: TaskCfg, seed: int) -> EpisodeLog:
        """Return a new log of one episode per world with the flags' command.

        seed has no effect: the environment's random streams sample the commands.
        """
        return EpisodeLog(tile_command(self.command, self.num_episodes, task), task, self.seconds)

    def metrics(self, log: EpisodeLog) -> Metrics:
        """Return lengths, heights and outcomes of a finished log of episodes as metrics.

        Identical episodes count as one trial, and one line on standard error says so.
        """
        if not log.identical:
            return episode_metrics(log)
        reason = "nothing was sampled; they count as one trial. --randomize samples robots"
        print(f"jumper: all {log.count} episodes are identical: {reason}", file=sys.stderr)
        return episode_metrics(log, 1)


@dataclass(frozen=True)
class EpisodePlayFlags:
    """Flags of `jumper play` for an episode of one robot."""

    command: tuple[float, ...] = ()
    """Up to four values of the task's command; omitted ones are 0 (default: the task's reset samples each command)."""

    length = 10.0  # [s] Length of the recording

    def __post_init__(self) -> None:
        """Raise InputError for a command or length out of range."""
        check_episodes(1, self.command, self.length)

    def log(self, task: TaskCfg) -> EpisodeLog:
        """Return a new log of one robot's episode of at most `length` [s]."""
        return EpisodeLog(tile_command(self.command, 1, task), task, self.length)
