"""Tasks of jumps that wait and rest in a crouch: the base of the jumps on Mars, and the jump onto blocks.

They differ from `vertical_jump` and `horizontal_jump` in what makes these stand: posture, squat, long waits and a long
rest. Their policies rest for one second only, so their evaluations hold for one second, too.
"""

from __future__ import annotations

from dataclasses import replace

from jumper_warp.tasks.cfg import ObservationsCfg, TaskCfg
from jumper_warp.tasks.jump.cfg import Level, StartProbability, cross_levels
from jumper_warp.tasks.jump.horizontal import NEAREST, horizontal_jump, level
from jumper_warp.tasks.jump.observations import SIGHTED, critic
from jumper_warp.tasks.jump.vertical import STARTS, vertical_jump
from jumper_warp.tasks.observations import remembered
from jumper_warp.tasks.randomization import RandomizationCfg
from jumper_warp.tasks.units import DEG, SECOND


def crouching(task: TaskCfg, start_probability: StartProbability, **reset: object) -> TaskCfg:
    """Return a copy of a jump task with short waits, one second of rest and no limit on the height of the stance.

    reset: further changed settings of `ResetCfg`.
    """
    settings = replace(task.reset.settings, start_probability=start_probability, long_wait_probability=0.0, **reset)
    task = replace(
        task, reset=replace(task.reset, settings=settings), evaluation=replace(task.evaluation, hold=1.0)
    ).without("terminations", "crouched")
    return task.with_terms("terminations", success={"steps": 1.0 * SECOND})


def crouching_vertical_jump() -> TaskCfg:
    """Return the task of a vertical jump that waits and rests with the thighs 35 deg from the default pose."""
    starts = StartProbability(0.50, default=0.15, in_flight=0.20, after_landing=0.05, pushing=0.10)
    task = crouching(vertical_jump(), starts)
    task = task.without("terminations", "shallow_squat", "turned_touchdown").without("rewards", "tracking", "squat")
    task = task.with_terms("terminations", moved_away={"distance": 0.30})
    return task.with_terms(
        "rewards", jump_height={"weight": 40.0},
        ground_posture={"weight": 10.0, "std": 10.0 * DEG, "shift": 35.0 * DEG},
    )  # fmt: skip


def crouching_horizontal_jump(levels: tuple[Level, ...]) -> TaskCfg:
    """Return the task of a jump ahead with these levels that waits and rests low, on floors that are not slippery."""
    starts = StartProbability(
        standing=0.40, default=0.15, in_flight=0.15, touchdown=0.15, after_landing=0.05, pushing=0.10
    )
    task = crouching(
        horizontal_jump(), starts, forward_pitch=10.0, takeoff_ahead=(0.0, 0.35), takeoff_pitch=(0.0, 15.0),
        touchdown_behind=(0.05, 0.20),
    )  # fmt: skip
    task = replace(task, randomization=RandomizationCfg(), levels=cross_levels(levels, STARTS))
    return task.without("rewards", "touchdown_tracking", "folded_legs").with_terms(
        "rewards", left_right_symmetry={"weight": 20.0}, base_at_rest={"weight": 40.0},
        standing_posture={"weight": 50.0, "std": 20.0 * DEG, "shift": 25.0 * DEG},
    )  # fmt: skip


def horizontal_jump_sighted() -> TaskCfg:
    """Return the task of a horizontal jump in which the policy observes edges and height of the block ahead."""
    reaches = (((0.25, 0.8), 0.15), ((0.3, 1.1), 0.3), ((0.3, 1.5), 0.35), ((0.3, 1.9), 0.35), ((0.3, 2.2), 0.35))
    task = crouching_horizontal_jump((NEAREST, *(level(*reach) for reach in reaches)))
    settings = task.reset.settings
    ground = replace(settings.ground, platform=0.30, block=0.45)
    return replace(
        task,
        name="horizontal-jump-sighted",
        observations=ObservationsCfg(actor=remembered(SIGHTED), critic=critic(SIGHTED)),
        reset=replace(task.reset, settings=replace(settings, ground=ground)),
    )
