"""Table EVALUATIONS of evaluation settings (flags, terminations), with `TaskCfg.evaluation_suite` as key."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any, Literal, Protocol

from jumper_warp.evaluation import velocities
from jumper_warp.evaluation.attitude import AttitudeFlags, AttitudePlayFlags
from jumper_warp.evaluation.episodes import EpisodeFlags, EpisodePlayFlags
from jumper_warp.evaluation.jump_metrics import (
    HEIGHT_PAPER,
    PLACE_PAPER,
    HeightFlags,
    HeightPlayFlags,
    LandingFlags,
    LandingPlayFlags,
)
from jumper_warp.evaluation.jumps import with_jump_terminations
from jumper_warp.evaluation.log import EvaluationLog
from jumper_warp.evaluation.velocities import VelocityFlags, VelocityPlayFlags
from jumper_warp.policies.spec import PolicyError
from jumper_warp.tasks.cfg import TaskCfg
from jumper_warp.utils.metrics import Metrics


class EvaluationFlags(Protocol):
    """Interface of a dataclass with the flags of `jumper evaluate` for some tasks, such as jumps to heights."""

    def log(self, task: TaskCfg, seed: int) -> EvaluationLog:
        """Return a new evaluation log, which sets all worlds' commands and records outcomes; seed: of the commands."""
        ...

    def metrics(self, log: Any) -> Metrics:
        """Return the metrics of a finished evaluation log that `self.log` returned."""
        ...


class PlayFlags(Protocol):
    """Interface of dataclasses with the flags of `jumper play` for a kind of task, such as jumps or walks."""

    @property
    def length(self) -> float:
        """Default length of the recording [s]."""
        ...

    def log(self, task: TaskCfg) -> EvaluationLog:
        """Return a new evaluation log, which sets the commands of all worlds and records their outcomes."""
        ...


@dataclass(frozen=True)
class Evaluation:
    """Settings of `jumper evaluate`, `play` and `finetune` for the policies of a task."""

    flags: EvaluationFlags  # Default flags of `jumper evaluate`
    play: PlayFlags  # Default flags of `jumper play`
    prepare_task: Callable[[TaskCfg], TaskCfg] = lambda task: task
    """Function that returns a copy of the task with the terminations of the evaluation."""
    finetune_target: Literal["apex", "landing"] | None = None
    """Error that `jumper finetune` reduces; None: these policies cannot be fine-tuned."""
    paper: Mapping[str, float] = field(default_factory=dict)  # Values in the paper of metrics with the same keys


HEIGHT_EVALUATION = Evaluation(HeightFlags(), HeightPlayFlags(), with_jump_terminations, "apex", HEIGHT_PAPER)
LANDING_EVALUATION = Evaluation(LandingFlags(), LandingPlayFlags(), with_jump_terminations, "landing", PLACE_PAPER)
EVALUATIONS: dict[str, Evaluation] = {
    "apex_height": HEIGHT_EVALUATION,
    "landing_position": LANDING_EVALUATION,
    "apex_height_mars": replace(
        HEIGHT_EVALUATION, paper={}, flags=HeightFlags(height_range=(1.0, 3.3), success_range=(1.0, 2.9)),
        play=HeightPlayFlags((1.5, 2.3, 3.0), 6.0),
    ),
    "landing_position_mars": replace(
        LANDING_EVALUATION, paper={}, flags=LandingFlags(goal_x=(0.5, 4.2), success_range=(0.5, 3.9)),
        play=LandingPlayFlags(default_goals=((1.0, 0.0), (2.5, 0.0), (3.9, 0.0))),
    ),
    "omnidirectional": replace(
        LANDING_EVALUATION, paper={}, finetune_target=None,
        flags=LandingFlags(goal_x=(-0.7, 0.7), goal_y=(-0.7, 0.7), success_range=(0.0, 0.7)),
        play=LandingPlayFlags(default_goals=((0.5, 0.0), (0.0, 0.5), (-0.5, 0.0))),
    ),
    "velocity": Evaluation(VelocityFlags(), VelocityPlayFlags(), TaskCfg.on_level_ground, paper=velocities.PAPER),
    "attitude": Evaluation(AttitudeFlags(), AttitudePlayFlags()),
    "episode": Evaluation(EpisodeFlags(), EpisodePlayFlags()),
}  # fmt: skip
"""Evaluations of tasks by name; a user's module may add entries."""


def evaluation_of(task: TaskCfg) -> Evaluation:
    """Return the evaluation settings of a task's policies. Raises PolicyError: EVALUATIONS lacks `evaluation_suite`."""
    if task.evaluation_suite not in EVALUATIONS:
        known = f"known are {[*EVALUATIONS]}"
        raise PolicyError(f"{task.name}: unknown evaluation_suite {task.evaluation_suite!r:.60}; {known}")
    return EVALUATIONS[task.evaluation_suite]
