"""Evaluation of jumps to heights and to landing positions: ranges of goals, and terminations of evaluated jumps."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import ClassVar

from jumper_warp.tasks.cfg import TaskCfg
from jumper_warp.tasks.evaluation import Evaluation
from jumper_warp.tasks.ranges import Pair

TERMINATIONS = ("diverged", "low_base", "collided", "no_jump", "success")
"""Terminations of an evaluated jump in order of precedence; success is last, so that falls take precedence."""


def with_jump_terminations(task: TaskCfg) -> TaskCfg:
    """Return a copy of a task that keeps only the terminations for evaluated jumps, in the order of TERMINATIONS.

    Terminations for training are left out.
    """
    terms = {term.name: term for term in task.terminations}
    return replace(task, terminations=tuple(terms[name] for name in TERMINATIONS if name in terms))


@dataclass(frozen=True)
class JumpEvaluation(Evaluation):
    """Base class of the evaluations of jumps from rest in the default pose."""

    goal_marker: ClassVar[str] = "goal"
    """Field of the state that live views mark: the place and, if it is commanded, the height of the apex."""
    hold: float = field(default=1.0, compare=False, kw_only=True)
    """[s] Time after touchdown until which nothing but the paws may touch anything."""

    def prepare_task(self, task: TaskCfg) -> TaskCfg:
        """Return a copy of a task that keeps only the terminations for evaluated jumps."""
        return with_jump_terminations(task)


@dataclass(frozen=True)
class HeightEvaluation(JumpEvaluation):
    """Evaluation of jumps to evenly spaced heights; the defaults are those of the paper's test."""

    height_range: Pair = (0.5, 1.2)
    """[m] Lowest and highest commanded base height."""
    success_range: Pair = (0.5, 1.1)
    """[m] Smallest and largest height counted by the `in_range` metrics."""
    height: tuple[float, ...] = (0.6, 0.9, 1.1)
    """[m] Commanded base heights of `jumper play`, one robot each."""
    length: float = 3.5
    """[s] Length of the recording of `jumper play`."""

    flags: ClassVar = "jumper_warp.evaluation.jump_metrics:Height"
    published: ClassVar = {"apex_error_abs_mean_m": 0.04, "goal_reached_rate": 0.91, "in_range_goal_reached_rate": 1.0}
    """Metrics of the paper's simulation; it evaluates the apex only."""


@dataclass(frozen=True)
class PlaceEvaluation(JumpEvaluation):
    """Evaluation of jumps to landing positions; the defaults are those of the paper's test."""

    goal_x: Pair = (0.3, 1.5)
    """[m] Smallest and largest distance of the goal ahead; goals are evenly spaced."""
    goal_y: Pair = (0.0, 0.0)
    """[m] Smallest and largest distance of the goal to the left; goals are sampled."""
    success_range: Pair = (0.3, 1.4)
    """[m] Smallest and largest distance counted by the `in_range` metrics."""
    default_goals: tuple[Pair, ...] = ((0.5, 0.0), (0.9, 0.0), (1.3, 0.0))
    """[m] Goals of `jumper play`, ahead and to the left, one robot each."""

    flags: ClassVar = "jumper_warp.evaluation.jump_metrics:Landing"
    published: ClassVar = {
        "success_rate": 0.97, "in_range_success_rate": 1.0, "goal_distance_at_rest_mean_m": 0.026,
        "goal_distance_at_end_mean_m": 0.026,
    }  # fmt: skip
    """Metrics of the paper's simulation."""
