"""Tasks without a departure from the paper that no flag of `jumper train` undoes; see the files beside this one."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

from jumper_warp import make_task
from jumper_warp.registry import register_task, trainer_settings
from jumper_warp.tasks.cfg import TaskCfg

Point = tuple[float, float, float]  # [m] x, y, z of a goal


def may_jump_early(task: TaskCfg) -> TaskCfg:
    """Return a copy of the task in which a takeoff before the command does not end the episode."""
    terminations = tuple(term for term in task.terminations if term.name != "early_takeoff")
    return replace(task, terminations=terminations)


def with_goals(task: TaskCfg, goals: Sequence[tuple[Point, Point]], starts: int) -> TaskCfg:
    """Return a copy of a jump task with other goals in its curriculum levels.

    The levels are every goal range with each of the last `starts` start height ranges.
    goals [m]: lower and upper point of each range; all other fields are those of the task's last level.
    """
    last = task.levels[-1]
    heights = [*dict.fromkeys(level.base_height for level in task.levels)][-starts:]
    levels = (replace(last, goal_lower=low, goal_upper=top, base_height=z) for low, top in goals for z in heights)
    return replace(task, levels=tuple(levels))


def heights_of_paper(task: TaskCfg) -> TaskCfg:
    """Return a copy of the task with goal heights of 0.6 to 1.1 m in three levels.

    All levels have the last range of start heights of the task.
    """
    return with_goals(task, [((0.0, 0.0, 0.6), (0.0, 0.0, top)) for top in (0.75, 0.9, 1.1)], starts=1)


def places_of_paper(task: TaskCfg) -> TaskCfg:
    """Return a copy of the task with goals 0.4 to 1.0 m ahead and up to 0.3 m to either side.

    There are four goal ranges, each with the last two ranges of start heights of the task.
    """
    tops = ((0.55, 0.0), (0.7, 0.1), (0.85, 0.2), (1.0, 0.3))
    return with_goals(task, [((0.4, -y, 0.0), (top, y, 0.0)) for top, y in tops], starts=2)


def places_of_sequel(task: TaskCfg) -> TaskCfg:
    """Return a copy of the Mars task with the goals of the authors' later paper on Mars, 1.4 to 4.75 m ahead.

    There are four goal ranges, each with the last two ranges of start heights of the task.
    """
    (_, *low), (_, *top) = task.levels[-1].goal_lower, task.levels[-1].goal_upper
    ahead = ((1.4, 1.85), (1.6, 2.25), (2.0, 3.75), (3.0, 4.75))
    return with_goals(task, [((near, *low), (far, *top)) for near, far in ahead], starts=2)


def without_another_goal(task: TaskCfg) -> TaskCfg:
    """Return a copy of the task in which a landed robot never gets a goal for a next jump."""
    return replace(task, levels=tuple(replace(level, next_jump_probability=0.0) for level in task.levels))


CHANGES: dict[str, dict[str, Callable[[TaskCfg], TaskCfg]]] = {
    "vertical-jump": {"jumping-early": may_jump_early, "goals": heights_of_paper},
    "horizontal-jump": {"goals": places_of_paper, "another-goal": without_another_goal},
    "horizontal-jump-mars-loose": {"goals": places_of_sequel},
}
"""Changes by task and name of the departure; the changed task is `TASK-NAME`."""


def register(base: str, name: str, change: Callable[[TaskCfg], TaskCfg]) -> None:
    """Register the task `base-name`, a change of `base` with the same settings of the trainer."""
    task = f"{base}-{name}"
    register_task(task, lambda: replace(change(make_task(base)), name=task), ppo=trainer_settings(base), about=name)


for BASE, OWN in CHANGES.items():
    for NAME, CHANGE in OWN.items():
        register(BASE, NAME, CHANGE)
