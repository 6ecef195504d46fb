"""Tasks of jumps on Mars (3.71 m/s^2), without springs, as in a second paper of the authors (below: the sequel).

The open-loop jump reaches 2.96 m with the filter of the jumps on Earth and 3.70 m with the loose filter. Each filter
has a task. Weights of the vertical jump are the sequel's, except for the angular velocity, since flights take up to
2.7 s. The sequel's levels start at 1.8 m; these start lower, have smaller steps, and all include low jumps. Limits on
impacts are those on Earth, since the robot is the same. Limits on landing errors grow by the factor FARTHER, like the
effect of a takeoff error.
"""

from __future__ import annotations

from dataclasses import replace

from jumper_warp.kernels.jump import rewards, terminations
from jumper_warp.robot.gravity import EARTH, MARS
from jumper_warp.robot.motors import MotorCfg, jumping_motors, loose_filter
from jumper_warp.tasks.cfg import TaskCfg
from jumper_warp.tasks.jump.cfg import GroundCfg, cross_levels
from jumper_warp.tasks.jump.evaluation import HeightEvaluation, PlaceEvaluation
from jumper_warp.tasks.jump.horizontal import NEAREST, horizontal_jump, level
from jumper_warp.tasks.jump.vertical import STARTS, heights, vertical_jump
from jumper_warp.tasks.terms import RewardTerm
from jumper_warp.tasks.units import DEG

TORQUE, KP = 24.8, 20.0  # [N m], [N m/rad] of the transversal motors
FARTHER = EARTH / MARS  # [1] ratio of heights and distances after the same takeoff


def mars_motors(lateral_torque: float) -> MotorCfg:
    """Return motors for Mars: transversal with 24.8 N m and kp 20 N m/rad, lateral with lateral_torque [N m]."""
    motors = jumping_motors(TORQUE, lateral_torque=lateral_torque)
    return replace(motors, transversal=replace(motors.transversal, kp=KP))


def vertical_jump_mars() -> TaskCfg:
    """Return the task of a vertical jump on Mars with the command filter of the vertical jump on Earth."""
    task = vertical_jump()
    task = replace(
        task,
        name="vertical-jump-mars",
        gravity=MARS,
        motors=mars_motors(10.0),
        levels=heights((0.7, 1.3), (0.7, 1.8), (0.7, 2.4), (0.7, 3.1)),
        evaluation=HeightEvaluation((1.0, 3.3), success_range=(1.0, 2.9), height=(1.5, 2.3, 3.0), length=6.0),
    )
    task = replace(task, curriculum=task.curriculum.replace(tolerance=0.05 * FARTHER))
    task = task.with_terms(
        "terminations", moved_away={"distance": 0.30 * FARTHER}, wrong_height={"tolerance": 0.10 * FARTHER},
        tilted={"angle": 40.0 * DEG},
    )  # fmt: skip
    ends = tuple(term for term in task.terminations if term.func is not terminations.second_takeoff)
    task = replace(task, terminations=ends)  # a bounce must not end episodes early in training
    descent_tilt = RewardTerm(rewards.descent_tilt, -60.0, angle=10.0 * DEG)  # long flights amplify slow rotation
    lifted_again = RewardTerm(rewards.lifted_again, -30.0, threshold=0.0)  # in place of `paws_down`
    terms = (lifted_again if term.func is rewards.paws_down else term for term in task.rewards)
    task = replace(task, rewards=(*terms, descent_tilt))
    return task.with_terms(
        "rewards",
        jump_height={"std_wide": 0.8},
        estimated_jump_height={"weight": 30.0, "std_wide": 0.8},
        angular_velocity={"weight": 10.0, "std": 0.5},
        air_posture={"weight": 70.0},
        ground_posture={"weight": 20.0},
        joint_symmetry={"weight": 15.0},
    )


def vertical_jump_mars_loose() -> TaskCfg:
    """Return the task of a vertical jump on Mars with goals up to 3.6 m and a less restrictive motor command filter."""
    return replace(
        vertical_jump_mars(),
        name="vertical-jump-mars-loose",
        command_filter=loose_filter(),
        levels=heights((0.7, 1.3), (0.7, 1.8), (0.7, 2.4), (0.7, 3.1), (0.7, 3.6)),
    )


def horizontal_jump_mars() -> TaskCfg:
    """Return the task of a horizontal jump on Mars, on level ground, with the command filter of the jump on Earth."""
    task = horizontal_jump()
    settings = replace(task.reset.settings, highest_apex=2.5, takeoff_angle=(35.0, 70.0), ground=GroundCfg())
    task = replace(
        task,
        name="horizontal-jump-mars",
        gravity=MARS,
        motors=mars_motors(12.0),
        levels=cross_levels(
            (NEAREST, level((0.5, 1.3), 0.1), level((1.0, 1.85), 0.2), level((1.4, 2.6), 0.3), level((2.0, 3.75), 0.3),
             level((3.0, 4.75), 0.3)), STARTS,
        ),
        reset=replace(task.reset, settings=settings),
        evaluation=PlaceEvaluation(
            (0.5, 4.2), success_range=(0.5, 3.9), default_goals=((1.0, 0.0), (2.5, 0.0), (3.9, 0.0))
        ),
    )  # fmt: skip
    task = replace(task, curriculum=task.curriculum.replace(tolerance=0.10 * FARTHER))
    task = task.with_terms(
        "terminations", predicted_miss={"tolerance": 0.55 * FARTHER}, missed_goal={"tolerance": 0.50 * FARTHER},
        turned_touchdown={"rotation": 40.0 * DEG, "yaw": 20.0 * DEG},
    )  # fmt: skip
    return task.with_terms(
        "rewards",
        estimated_tracking={"std_middle": 0.5, "std_wide": 1.2, "std_fine": 0.15},
        tracking={"std_wide": 0.4, "std_fine": 0.05},
    )


def horizontal_jump_mars_loose() -> TaskCfg:
    """Return the task of a horizontal jump on Mars with a less restrictive motor command filter, `loose_filter`."""
    return replace(horizontal_jump_mars(), name="horizontal-jump-mars-loose", command_filter=loose_filter())
