"""Evaluation of jumps to apex heights: log, metrics, and flags of `jumper evaluate` and `play`."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
import tyro

from jumper_warp.evaluation.jump_metrics import JumpFlags
from jumper_warp.evaluation.jumps import REST_TIME, JumpLog
from jumper_warp.evaluation.log import run_evaluation, termination_names
from jumper_warp.tasks.cfg import TaskCfg
from jumper_warp.utils.errors import InputError

if TYPE_CHECKING:
    import torch

    from jumper_warp.envs.env import Env

PAPER = {"apex_error_abs_mean_m": 0.04, "goal_reached_rate": 0.91, "in_range_goal_reached_rate": 1.0}
"""Metrics of the paper's simulation by key; the paper evaluates the apex only."""
MAX_ROBOTS = 64  # Maximum number of robots in one recording


class HeightLog(JumpLog):
    """Log of one jump to an apex height per world; arrays of `JumpLog` have shape (num_envs, 1)."""

    main_columns = ("goal_height_m", "apex_m", "apex_error_m", "tilt_deg", "outcome")

    def __init__(self, heights: np.ndarray, terminations: tuple[str, ...], rest: float = REST_TIME) -> None:
        """Create a log of jumps that have not begun.

        heights [m]: commanded base heights at the apex, (num_envs,), above the ground; terminations, rest: see
        `JumpLog`.
        """
        goals = np.zeros((len(heights), 1, 3))
        goals[:, 0, 2] = heights
        super().__init__(goals, terminations, rest=rest)

    @property
    def seconds(self) -> float:
        """Maximum simulated time [s]."""
        return 7.0 + self.rest

    @property
    def commanded(self) -> np.ndarray:
        """Commanded base height at the apex [m], (num_envs, 1)."""
        return self.goals[..., 2]

    @property
    def reached(self) -> np.ndarray:
        """Whether the apex was within 0.1 m of the command, (num_envs, 1)."""
        return self.outcome.reached

    def series(self, worlds: Sequence[int]) -> dict[str, float]:
        """Return the current and the commanded base height [m] of some worlds."""
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
    """Run one jump per world to commanded heights [m], (num_envs,), return the log; act: see `run_evaluation`."""
    jumps = HeightLog(heights, termination_names(env.task))
    run_evaluation(act, env, jumps)
    return jumps


@dataclass(frozen=True)
class HeightFlags(JumpFlags):
    """Flags of jumps to evenly spaced heights."""

    success_range: tuple[float, float] = field(default=(0.5, 1.1), kw_only=True)
    height_range: tuple[float, float] = (0.5, 1.2)  # [m] Lowest and highest commanded base height

    def __post_init__(self) -> None:
        super().__post_init__()
        if not 0.0 < self.height_range[0] <= self.height_range[1] < 10.0:
            raise InputError(f"height_range must be in (0, 10) m and rise, got {self.height_range}")

    def log(self, task: TaskCfg, seed: int) -> HeightLog:
        """Return a new log of one jump per world to evenly spaced heights; seed has no effect."""
        return HeightLog(np.linspace(*self.height_range, self.num_jumps), termination_names(task))


@dataclass(frozen=True)
class HeightPlayFlags:
    """Flags of recorded jumps to heights."""

    height: tuple[float, ...] = (0.6, 0.9, 1.1)  # [m] Commanded base heights, one robot each
    length: tyro.conf.Suppress[float] = 3.5  # [s] Length of the recording, unless `jumper play --seconds` sets it

    def __post_init__(self) -> None:
        if not 1 <= len(self.height) <= MAX_ROBOTS or not all(0.0 < height < 10.0 for height in self.height):
            raise InputError(f"height takes 1 to {MAX_ROBOTS} numbers in (0, 10) m, got {self.height}")

    def log(self, task: TaskCfg) -> HeightLog:
        """Return a new log of one recorded jump per robot."""
        return HeightLog(np.array(self.height), termination_names(task))
