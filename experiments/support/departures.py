"""Ablations of the jump tasks: each undoes one departure from the paper and its authors' configuration.

`docs/results/departures.csv` has all departures and their reasons, `docs/results/paper.md` the effects of these,
measured by `experiments/departures.py`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

from jumper_warp.tasks.cfg import TaskCfg

Ablation = str | Callable[[TaskCfg], TaskCfg]
"""Change that undoes a departure: flags of `jumper train TASK`, or a function that returns the task without it."""
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
    last, heights = task.levels[-1], [*dict.fromkeys(level.base_height for level in task.levels)][-starts:]
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
    """Return a copy of the Mars task with the goals of the authors' sequel, 1.4 to 4.75 m ahead.

    There are four goal ranges, each with the last two ranges of start heights of the task.
    """
    (_, *low), (_, *top) = task.levels[-1].goal_lower, task.levels[-1].goal_upper
    ahead = ((1.4, 1.85), (1.6, 2.25), (2.0, 3.75), (3.0, 4.75))
    return with_goals(task, [((near, *low), (far, *top)) for near, far in ahead], starts=2)


def alike_all_around(task: TaskCfg) -> TaskCfg:
    """Return a copy of the task with circular instead of elliptical goal ranges.

    The radius is the reach ahead.
    """
    levels = list(task.levels)
    for i, level in enumerate(levels):
        reach = level.goal_upper[0]
        if level.elliptical:
            levels[i] = replace(level, goal_lower=(-reach, -reach, 0.0), goal_upper=(reach, reach, 0.0))
    return replace(task, levels=tuple(levels))


def without_another_goal(task: TaskCfg) -> TaskCfg:
    """Return a copy of the task in which a landed robot never gets a goal for a next jump."""
    return replace(task, levels=tuple(replace(level, next_jump_probability=0.0) for level in task.levels))


DEPARTURES: dict[str, dict[str, Ablation]] = {
    "vertical-jump": {
        "standing_still_and_level": "--env.rewards.base-at-rest.weight 0 --env.rewards.landing-tilt.weight 0",
        "paws_down": "--env.rewards.paws-down.weight 0",
        "second_takeoff": "--env.terminations.second-takeoff.speed 100",
        "quiet_standing": (
            "--env.rewards.resting-action-rate.weight 0 --env.rewards.torque-ripple.weight 0 "
            "--env.rewards.force-ripple.weight 0"
        ),
        "changes_of_the_action": "--env.rewards.action-rate.weight -0.1",
        "one_step_seen": "--history 1",
        "links_may_come_near": "--env.self-collision-margin 0",
        "shares_of_resets": "--env.reset.balance-by resets",
        "none_pushing_off": "--env.reset.start-probability.pushing 0 --env.reset.start-probability.standing 0.6",
        "promoted_after_one": "--env.curriculum.promote-after 1",
        "jumping_early": may_jump_early,
        "ground_forces": "--env.rewards.ground-force.weight 0",
        "rewards_below_zero": "--env.reward-floor None",
        "critic_sees_what_the_actor_does": "--ppo.no-asymmetric-critic",
        "entropy": "--ppo.entropy-coef 0.00075 --ppo.final-desired-kl 0.01",
        "goals": heights_of_paper,
        "drift": "--env.terminations.moved-away.distance 0.2",
        "starts": "--env.reset.tilt 1 --env.reset.base-xy 0",
    },
    "horizontal-jump": {
        "estimated_tracking": "--env.rewards.estimated-tracking.std-fine 0.001",
        "error_at_touchdown": "--env.terminations.missed-goal.tolerance 0.2",
        "predicted_error": "--env.terminations.predicted-miss.tolerance 0.45",
        "base_at_touchdown": "--env.terminations.low-touchdown.height 0.3",
        "symmetry": "--env.rewards.left-right-symmetry.waiting-scale 1",
        "bracing": "--env.rewards.capture-point.weight 0",
        "goals": places_of_paper,
        "heading": "--env.reset.heading 0",
        "no_command_delay": "--env.reset.command-delay 0",
        "level_squats": "--env.reset.lean 0",
        "takeoffs": "--env.reset.takeoff-angle 50 75 --env.reset.takeoff-ahead 0 0.1 --env.reset.takeoff-pitch 0 0",
        "touchdowns": "--env.reset.touchdown-behind 0 0",
        "another_goal": without_another_goal,
        "level_ground": "--env.reset.ground.platform 0 --env.reset.ground.block 0",
    },
    "omnidirectional-jump": {"reaches": alike_all_around},
    "horizontal-jump-mars-loose": {
        "goals": places_of_sequel,
        "wide_kernels": (
            "--env.rewards.estimated-tracking.std-middle 0.3 --env.rewards.estimated-tracking.std-wide 0.5 "
            "--env.rewards.estimated-tracking.std-fine 0.1 --env.rewards.tracking.std-wide 0.15 "
            "--env.rewards.tracking.std-fine 0.03"
        ),
        "limits": (
            "--env.terminations.predicted-miss.tolerance 0.55 --env.terminations.missed-goal.tolerance 0.5 "
            "--env.terminations.turned-touchdown.rotation 0.3491 --env.terminations.turned-touchdown.yaw 0.1745 "
            "--env.curriculum.tolerance 0.1"
        ),
    },
}
"""Ablations by task and name; most of the vertical jump also apply to the horizontal one; Mars refers to the sequel."""


def ablation_flags(ablation: Ablation) -> str:
    """Return the flags of `jumper train` that make an ablation; empty if it is a function that changes the task."""
    return ablation if isinstance(ablation, str) else ""
