"""How policies are evaluated and played, by the key that a task names in `TaskCfg.evaluation`."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, Literal, Protocol

from jumper_warp.evaluation import heights, places
from jumper_warp.evaluation.episodes import EpisodeFlags, EpisodeGoals
from jumper_warp.evaluation.heights import HeightFlags, HeightGoals
from jumper_warp.evaluation.log import EvaluationLog, Metrics
from jumper_warp.evaluation.places import PlaceFlags, PlaceGoals
from jumper_warp.evaluation.turns import TurnFlags, TurnGoals
from jumper_warp.evaluation.velocities import VelocityFlags, VelocityGoals
from jumper_warp.policies.spec import PolicyError
from jumper_warp.tasks.cfg import TaskCfg


class EvaluationFlags(Protocol):
    """A frozen dataclass: flags of `jumper evaluate`."""

    def log(self, task: TaskCfg, seed: int) -> EvaluationLog:
        """Return what is asked for, one row a world."""
        ...

    def metrics(self, log: Any) -> Metrics:
        """Return what to report of its log."""
        ...


class PlayFlags(Protocol):
    """A frozen dataclass: flags of `jumper play`."""

    @property
    def length(self) -> float:
        """[s] Of the recording."""
        ...

    def log(self, task: TaskCfg) -> EvaluationLog:
        """Return what is asked for, one row a world."""
        ...


@dataclass(frozen=True)
class Evaluation:
    """How policies of a task are evaluated."""

    flags: EvaluationFlags
    """What is asked for in an evaluation, unless told otherwise."""
    play: PlayFlags
    """What is played, unless told otherwise."""
    for_evaluation: Callable[[TaskCfg], TaskCfg] = lambda task: task
    """Returns the task with the terminations that count here."""
    misses: Literal["height", "place"] | None = None
    """What `jumper finetune` makes its jumps miss by less; None: it does not know how."""


HEIGHT = Evaluation(HeightFlags(), HeightGoals(), heights.for_evaluation, "height")
PLACE = Evaluation(PlaceFlags(), PlaceGoals(), places.for_evaluation, "place")
EVALUATIONS: dict[str, Evaluation] = {
    "height": HEIGHT,
    "place": PLACE,
    "height-mars": replace(
        HEIGHT, flags=HeightFlags(height_range=(1.0, 3.3), success_range=(1.0, 2.9)),
        play=HeightGoals((1.5, 2.3, 3.0), 6.0),
    ),
    "place-mars": replace(
        PLACE, flags=PlaceFlags(goal_x=(0.5, 4.2), success_range=(0.5, 3.9)),
        play=PlaceGoals(unless_told=((1.0, 0.0), (2.5, 0.0), (3.9, 0.0))),
    ),
    "around": replace(
        PLACE, flags=PlaceFlags(goal_x=(-0.7, 0.7), goal_y=(-0.7, 0.7), success_range=(0.0, 0.7)), misses=None,
        play=PlaceGoals(unless_told=((0.5, 0.0), (0.0, 0.5), (-0.5, 0.0))),
    ),
    "velocity": Evaluation(VelocityFlags(), VelocityGoals(), TaskCfg.on_level_ground),
    "attitude": Evaluation(TurnFlags(), TurnGoals()),
    "episode": Evaluation(EpisodeFlags(), EpisodeGoals()),
}  # fmt: skip
"""A user's module may add its own."""


def evaluation_of(task: TaskCfg) -> Evaluation:
    """Return how policies of a task are evaluated. Raises PolicyError for a key that is not there."""
    if task.evaluation not in EVALUATIONS:
        raise PolicyError(f"{task.name} asks for the evaluation {task.evaluation!r:.60}; there are {[*EVALUATIONS]}")
    return EVALUATIONS[task.evaluation]
