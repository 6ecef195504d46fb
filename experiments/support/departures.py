"""Departures of the jumps from the paper and its authors' configuration, undone one at a time.

`docs/tasks.md` tells their reasons, and what `experiments/departures.py` found that they change.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

from jumper_warp.tasks.cfg import TaskCfg
from jumper_warp.tasks.jump.cfg import Level


def unchanged(task: TaskCfg) -> TaskCfg:
    """Return the task."""
    return task


@dataclass(frozen=True)
class Undone:
    """How a departure is undone."""

    flags: str = ""
    """Of `jumper train TASK`."""
    change: Callable[[TaskCfg], TaskCfg] = unchanged
    """What no flag can: returns the task without the departure."""


def may_jump_early(task: TaskCfg) -> TaskCfg:
    """Return the task in which a takeoff before the command ends nothing."""
    kept = tuple(term for term in task.terminations if term.name != "early_takeoff")
    return replace(task, terminations=kept)


def with_goals(task: TaskCfg, goals: tuple[Level, ...], starts: int) -> TaskCfg:
    """Return the task with other levels of goals, each with the last starts of the task's own, so many of them."""
    ranges = tuple(dict.fromkeys(level.base_height for level in task.levels))[-starts:]
    return replace(task, levels=tuple(replace(goal, base_height=start) for goal in goals for start in ranges))


def heights_of_paper(task: TaskCfg) -> TaskCfg:
    """Return the task with heights of 0.6 to 1.1 m in three steps, and all starts from the first on."""
    last = task.levels[-1]
    tops = (0.75, 0.9, 1.1)
    goals = tuple(replace(last, goal_lower=(0.0, 0.0, 0.6), goal_upper=(0.0, 0.0, top)) for top in tops)
    return with_goals(task, goals, starts=1)


def places_of_paper(task: TaskCfg) -> TaskCfg:
    """Return the task with places 0.4 to 1.0 m ahead, up to 0.3 m aside, in four steps, two starts each."""
    last, lateral = task.levels[-1], (0.0, 0.1, 0.2, 0.3)
    tops = (0.55, 0.7, 0.85, 1.0)
    goals = tuple(
        replace(last, goal_lower=(0.4, -y, 0.0), goal_upper=(top, y, 0.0)) for top, y in zip(tops, lateral, strict=True)
    )
    return with_goals(task, goals, starts=2)


def places_of_sequel(task: TaskCfg) -> TaskCfg:
    """Return the task on Mars with places 1.4 to 4.75 m ahead in the four steps of the sequel, two starts each."""
    last, goals = task.levels[-1], []
    for low, top in ((1.4, 1.85), (1.6, 2.25), (2.0, 3.75), (3.0, 4.75)):
        lower, upper = (low, *last.goal_lower[1:]), (top, *last.goal_upper[1:])
        goals.append(replace(last, goal_lower=lower, goal_upper=upper))
    return with_goals(task, tuple(goals), starts=2)


def alike_all_around(task: TaskCfg) -> TaskCfg:
    """Return the task with goals that are as far aside and back as ahead."""

    def circle(level: Level) -> Level:
        reach = level.goal_upper[0]
        return replace(level, goal_lower=(-reach, -reach, 0.0), goal_upper=(reach, reach, 0.0))

    return replace(task, levels=tuple(circle(level) if level.round else level for level in task.levels))


def without_another_goal(task: TaskCfg) -> TaskCfg:
    """Return the task in which no landed robot gets another goal."""
    return replace(task, levels=tuple(replace(level, jump_again=0.0) for level in task.levels))


VERTICAL: dict[str, Undone] = {
    "standing_still_and_level": Undone("--env.rewards.rest.weight 0 --env.rewards.landing-tilt.weight 0"),
    "paws_down": Undone("--env.rewards.paws-down.weight 0"),
    "second_takeoff": Undone("--env.terminations.second-takeoff.speed 100"),
    "quiet_standing": Undone(
        "--env.rewards.resting-action-rate.weight 0 --env.rewards.torque-ripple.weight 0 "
        "--env.rewards.force-ripple.weight 0"
    ),
    "changes_of_the_action": Undone("--env.rewards.action-rate.weight -0.1"),
    "one_step_seen": Undone("--history 1"),
    "links_may_come_near": Undone("--env.link-margin 0"),
    "shares_of_resets": Undone("--env.reset.shares-of resets"),
    "none_pushing_off": Undone("--env.reset.pushing 0 --env.reset.standing 0.6"),
    "promoted_after_one": Undone("--env.curriculum.promote-after 1"),
    "tolerance_of_levels": Undone("--env.curriculum.tolerance 0.1"),
    "jumping_early": Undone(change=may_jump_early),
    "ground_forces": Undone("--env.rewards.ground-force.weight 0"),
    "rewards_below_zero": Undone("--env.reward-floor None"),
    "critic_sees_what_the_actor_does": Undone("--ppo.no-asymmetric"),
    "entropy": Undone("--ppo.entropy-coef 0.00075 --ppo.final-kl 0.01"),
    "goals": Undone(change=heights_of_paper),
    "drift": Undone("--env.terminations.moved-away.distance 0.2"),
    "starts": Undone("--env.reset.tilt 1 --env.reset.base-xy 0"),
}
"""Of the vertical jump, most of them the horizontal jump's too."""

HORIZONTAL: dict[str, Undone] = {
    "estimated_tracking": Undone("--env.rewards.estimated-tracking.fine 0.001"),
    "error_at_touchdown": Undone("--env.terminations.missed-goal.tolerance 0.2"),
    "predicted_error": Undone("--env.terminations.predicted-miss.tolerance 0.45"),
    "base_at_touchdown": Undone("--env.terminations.low-touchdown.height 0.3"),
    "symmetry": Undone("--env.rewards.left-right-symmetry.share 1"),
    "bracing": Undone("--env.rewards.capture-point.weight 0"),
    "goals": Undone(change=places_of_paper),
    "heading": Undone("--env.reset.heading 0"),
    "no_command_delay": Undone("--env.reset.command-delay 0"),
    "level_squats": Undone("--env.reset.lean 0"),
    "takeoffs": Undone("--env.reset.takeoff-angle 50 75 --env.reset.takeoff-ahead 0 0.1 --env.reset.takeoff-pitch 0 0"),
    "touchdowns": Undone("--env.reset.touchdown-behind 0 0"),
    "another_goal": Undone(change=without_another_goal),
    "level_ground": Undone("--env.reset.ground.platform 0 --env.reset.ground.block 0"),
}
"""Of the horizontal jump alone."""

ALL_AROUND: dict[str, Undone] = {"reaches": Undone(change=alike_all_around)}
"""Of the jump all around, besides."""

ON_MARS: dict[str, Undone] = {
    "goals": Undone(change=places_of_sequel),
    "wide_kernels": Undone(
        "--env.rewards.estimated-tracking.middle 0.3 --env.rewards.estimated-tracking.wide 0.5 "
        "--env.rewards.estimated-tracking.fine 0.1 --env.rewards.tracking.wide 0.15 --env.rewards.tracking.fine 0.03"
    ),
    "limits": Undone(
        "--env.terminations.predicted-miss.tolerance 0.55 --env.terminations.missed-goal.tolerance 0.5 "
        "--env.terminations.turned-touchdown.rotation 0.3491 --env.terminations.turned-touchdown.yaw 0.1745 "
        "--env.curriculum.tolerance 0.1"
    ),
}
"""Of the horizontal jump on Mars from the authors' sequel."""

DEPARTURES: dict[str, dict[str, Undone]] = {
    "vertical-jump": VERTICAL,
    "horizontal-jump": HORIZONTAL,
    "omnidirectional-jump": ALL_AROUND,
    "horizontal-jump-mars-loose": ON_MARS,
}
"""By task and name."""
