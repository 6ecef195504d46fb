"""Tasks of jumps by a robot that stands: it waits at a base height of 0.35 m, squats for the jump, and stands up again.

The other tasks wait and rest in a crouch, as in the authors' configuration, and are learnt in a tenth of the time. A
robot that stands must lower its base before it jumps, as much as the jump needs, and catch itself on longer legs.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from jumper_warp.kernels.jump import rewards, terminations
from jumper_warp.robot.motors import JUMP_TRANSVERSAL
from jumper_warp.tasks.cfg import TaskCfg
from jumper_warp.tasks.jump.cfg import Level, StartProbability, cross_levels
from jumper_warp.tasks.jump.evaluation import HeightEvaluation, PlaceEvaluation
from jumper_warp.tasks.jump.horizontal import NEAREST, NEXT_JUMP_PROBABILITY, horizontal_jump
from jumper_warp.tasks.jump.vertical import STARTS, heights, vertical_jump
from jumper_warp.tasks.randomization import RandomizationCfg
from jumper_warp.tasks.terms import RewardTerm, TerminationTerm
from jumper_warp.tasks.units import DEG, SECOND

STANCE = 12.0 * DEG  # [rad] of the thighs from the default pose: a base height of 0.35 m
LOWEST_STANCE = 0.28  # [m] Base height below which the robot crouches
THIGH_LIMIT = 110.0  # [deg] Largest target of thighs, which stand straight up at 180 deg
HOLD = 5.0  # [s] Time after touchdown for which an evaluated robot must stand
FRICTION = RandomizationCfg(static_friction=(0.4, 1.2), dynamic_friction=(0.35, 0.9))
"""Random robots whose paws also stand on slippery ground."""
SQUAT: dict[str, Any] = {"takeoff_height": 0.31, "acceleration": 50.0, "floor": 0.15}
"""[m], [m/s^2], [m] Parameters of the squat that a height needs: 0.27 m for 0.5 m, 0.165 m for 1.05 m."""


def standing(task: TaskCfg, start_steps: float, long_wait_probability: float, starts: StartProbability) -> TaskCfg:
    """Return a copy of a jump task whose robots must not crouch, wait for up to 4 s, and rest for 3 s.

    start_steps: policy steps from the start of an episode after which crouching ends it.
    """
    crouched = TerminationTerm(
        terminations.crouched, height=LOWEST_STANCE, start_steps=start_steps, landing_steps=1.5 * SECOND
    )
    settings = replace(
        task.reset.settings, start_probability=starts, long_wait_probability=long_wait_probability, long_wait=4.0
    )
    task = replace(task, reset=replace(task.reset, settings=settings), terminations=(*task.terminations, crouched))
    return task.with_terms("terminations", success={"steps": 3.0 * SECOND})


def vertical_jump_standing() -> TaskCfg:
    """Return the task of a vertical jump from a stance, with a squat as deep as the height needs, and little drift."""
    starts = StartProbability(0.45, default=0.15, in_flight=0.20, after_landing=0.10, pushing=0.10)
    task = standing(vertical_jump(), 0.3 * SECOND, 0.2, starts)
    task = replace(
        task,
        name="vertical-jump-standing",
        rewards=(
            *task.rewards,
            RewardTerm(rewards.squat, 100.0, std=0.03, scale_by_dt=False, **SQUAT),
            RewardTerm(rewards.tracking, 40.0, std_wide=0.15, std_fine=0.03, fine_weight=0.6),
            RewardTerm(rewards.touchdown_tracking, 120.0, std=0.05, scale_by_dt=False),
        ),
        terminations=(
            *task.terminations,
            TerminationTerm(terminations.shallow_squat, tolerance=0.04, **SQUAT),
            TerminationTerm(terminations.turned_touchdown, rotation=25.0 * DEG, yaw=15.0 * DEG),
        ),
        levels=heights((0.45, 0.70), (0.45, 0.95), (0.45, 1.15)),
        randomization=replace(FRICTION, latency=(0.0, 18.0), zero_latency_probability=0.1),
        evaluation=HeightEvaluation(hold=HOLD),
    )
    task = task.with_terms("terminations", moved_away={"distance": 0.25})
    return task.with_terms(
        "rewards", jump_height={"weight": 80.0, "scale_sharp": 0.025}, estimated_jump_height={"scale_sharp": 0.025},
        horizontal_velocity={"weight": 25.0}, ground_posture={"weight": 40.0, "std": 20.0 * DEG, "shift": STANCE},
    )  # fmt: skip


def level_all_around(ahead: float, around: float) -> Level:
    """Return a curriculum level with goals in all directions, inside an ellipse around the start.

    Arguments: its half axes [m] ahead, and to either side and back.
    """
    return Level((-around, -around, 0.0), (ahead, around, 0.0), STARTS[0], NEXT_JUMP_PROBABILITY, elliptical=True)


REACHES = ((0.5, 0.3), (0.9, 0.5), (1.3, 0.7), (1.7, 0.9), (2.2, 0.95))
"""[m] Farthest goals, ahead and in other directions, of each level above the first."""


def horizontal_jump_standing() -> TaskCfg:
    """Return the task of a jump from a stance in any direction, with paw friction coefficients of 0.35 to 1.2.

    A jump to the side needs different motions of left and right legs: the reward of symmetry is half that of the jump
    ahead.
    """
    starts = StartProbability(
        standing=0.30, default=0.15, in_flight=0.15, touchdown=0.10, after_landing=0.20, pushing=0.10
    )
    task = standing(horizontal_jump(), 0.5 * SECOND, 0.3, starts)
    settings = replace(
        task.reset.settings, forward_pitch=0.0, takeoff_pitch=(0.0, 0.0), takeoff_ahead=(0.0, 0.2),
        touchdown_behind=(0.05, 0.12), transversal_limit=130.0,
    )  # fmt: skip
    task = replace(
        task,
        name="horizontal-jump-standing",
        reset=replace(task.reset, settings=settings),
        rewards=(
            *task.rewards,
            RewardTerm(rewards.touchdown_tracking, 200.0, std=0.10, scale_by_dt=False),
            RewardTerm(rewards.settled, 600.0, first=0.9 * SECOND, last=1.1 * SECOND, std=0.12),
        ),
        terminations=(*task.terminations, TerminationTerm(terminations.walked, margin=0.08, fraction=0.25)),
        curriculum=task.curriculum.replace(promote_after=1),
        command_filter=replace(task.command_filter, transversal=replace(JUMP_TRANSVERSAL, upper=THIGH_LIMIT)),
        levels=cross_levels((NEAREST, *(level_all_around(*reach) for reach in REACHES)), STARTS),
        randomization=replace(FRICTION, latency=(0.0, 20.0), zero_latency_probability=0.1),
        evaluation=PlaceEvaluation(hold=HOLD),
    )
    return task.with_terms(
        "rewards", left_right_symmetry={"weight": 10.0}, base_at_rest={"weight": 80.0},
        standing_posture={"weight": 200.0, "std": 30.0 * DEG, "shift": STANCE},
    )  # fmt: skip
