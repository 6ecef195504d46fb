"""Ranges of the commands that a task samples in training, and a warning about commands beyond them."""

from __future__ import annotations

import sys
from typing import Any, NamedTuple

import numpy as np

from jumper_warp.evaluation.jumps import JumpLog
from jumper_warp.evaluation.log import EvaluationLog, within
from jumper_warp.tasks.cfg import TaskCfg
from jumper_warp.utils.metrics import Metrics, rate

TOLERANCE = 1.0e-6  # [m], [m/s], [rad/s] Distance from a range that counts as rounding


class Bounds(NamedTuple):
    """Range of values that one component of a command has in training."""

    index: int  # Column in a command: x, y, z, or velocity ahead, to the left, about z
    name: str
    unit: str
    low: float
    high: float


def trained_bounds(task: TaskCfg) -> tuple[Bounds, ...]:
    """Return the ranges of all command components over a task's curriculum levels; empty unless it jumps or walks."""
    levels: Any = task.levels or (None,)
    if hasattr(levels[0], "goal_lower"):
        lower = np.min([level.goal_lower for level in levels], axis=0).tolist()
        upper = np.max([level.goal_upper for level in levels], axis=0).tolist()
        names = ((2, "height"),) if upper[2] > 0.0 else ((0, "distance ahead"), (1, "distance to the left"))
        return tuple(Bounds(i, name, "m", lower[i], upper[i]) for i, name in names)
    if not hasattr(levels[0], "last_range"):
        return ()
    ahead, back, side, yaw = levels[-1].last_range
    return (
        Bounds(0, "velocity ahead", "m/s", -back, ahead),
        Bounds(1, "velocity to the left", "m/s", -side, side),
        Bounds(2, "yaw rate", "rad/s", -yaw, yaw),
    )


def trained_range(task: TaskCfg) -> dict[str, list[float]]:
    """Return the ranges of the commands that a task samples in training, by name; empty unless it jumps or walks.

    `trained_range_m`: smallest and largest apex height or distance straight ahead; `trained_velocities`: largest
    velocities ahead, back, to either side [m/s] and about z [rad/s].
    """
    bounds = trained_bounds(task)
    if not bounds:
        return {}
    if bounds[0].unit == "m":
        return {"trained_range_m": [max(bounds[0].low, 0.0), bounds[0].high]}
    return {"trained_velocities": list(task.levels[-1].last_range)}


def warn_beyond_training(task: TaskCfg, commands: np.ndarray | None) -> None:
    """Print a warning on standard error if commands are beyond the ranges of the task's training.

    commands: (..., 3), x, y, z [m] or velocities [m/s], [m/s], [rad/s]; the line names the farthest value of each
    component. None: no line.
    """
    words = []
    rows = np.zeros((0, 3)) if commands is None else np.reshape(commands, (-1, commands.shape[-1]))
    for index, name, unit, low, high in trained_bounds(task) if len(rows) else ():
        values = rows[:, index]
        excess = np.maximum(low - values, values - high)
        if excess.max() > TOLERANCE:
            words.append(f"{name} {values[excess.argmax()]:g} {unit} (trained {low:g} to {high:g})")
    if words:
        print(f"jumper: beyond the training of {task.name}: {', '.join(words)}", file=sys.stderr)


def trained_success(task: TaskCfg, log: EvaluationLog) -> Metrics:
    """Return the success rates of first jumps with goals within and beyond the range of training, if both occur.

    Keys: `within_training_success_rate`, `beyond_training_success_rate`.
    """
    bounds = trained_bounds(task)
    if not isinstance(log, JumpLog) or not bounds:
        return {}
    goals = log.goals[:, 0]
    inside = np.all([within(goals[:, bound.index], (bound.low, bound.high)) for bound in bounds], axis=0)
    if inside.all() or not inside.any():
        return {}
    success = log.success[:, 0]
    ranges = " × ".join(f"{bound.low:g} to {bound.high:g}" for bound in bounds)
    return {
        "within_training_success_rate": rate(success[inside], f"jumps with goals of trained {ranges} m"),
        "beyond_training_success_rate": rate(success[~inside], "jumps beyond training"),
    }
