"""The vertical jump: reach a commanded base height, and land.

Forms and constants are the paper's and its authors' training configuration. Three changes make it learn instead of
standing still for the terms that pay always: while a commanded jump has not begun these count a tenth (the posture on
the ground too, or squatting would cost), both height terms have a wide third kernel, and the first levels ask for low
jumps. An episode ends if the robot jumps before it is told to. The height at the apex pays twice, orientation three
times as much; rest after landing pays and tilt costs; changes of the action cost ten times as much.
"""

from __future__ import annotations

from jumper_warp.robot.motors import jumping_motors, vertical_jump_filter
from jumper_warp.tasks.cfg import Level, ResetCfg, Rule, TaskCfg, Term
from jumper_warp.tasks.units import DEG, SECOND, G
from kernels.jump import errors as jump_errors
from kernels.jump import observe, rewards, terminations

PATIENCE = 0.1
"""Share that the always-paid terms keep while a commanded jump has not begun."""

TERMS = (
    Term(rewards.jump_height, 40.0, (0.10, 0.05, 0.4), once=True),
    Term(rewards.estimated_jump_height, 20.0, (0.10, 0.05, 0.4)),
    Term(rewards.horizontal_velocity, 10.0, (0.04, PATIENCE)),
    Term(rewards.orientation, 15.0, (0.1, PATIENCE)),
    Term(rewards.angular_velocity, 2.0, (2.0, PATIENCE)),
    Term(rewards.joint_symmetry, 35.0, (0.05, 0.35, PATIENCE)),
    Term(rewards.ground_posture, 30.0, (10.0 * DEG, 35.0 * DEG, PATIENCE)),
    Term(rewards.air_posture, 80.0, (15.0 * DEG,)),
    Term(rewards.retract, 10.0, (15.0 * DEG, 15.0 * DEG)),
    Term(rewards.rest, 20.0, (0.1, 0.5)),
    Term(rewards.landing_tilt, -120.0, (10.0 * DEG,)),
    Term(rewards.soft_impact, 5.0, (5.0 * G,)),
    Term(rewards.stance_impact, 100.0, (2.5 * G,)),
    Term(rewards.catch_landing, 3.0),
    Term(rewards.damp_landing, 10.0),
    Term(rewards.ground_force, -0.5, (14.5 * G,)),
    Term(rewards.action_clip, -1.0),
    Term(rewards.motor_torque_sq, -5.0e-4),
    Term(rewards.joint_acceleration, -1.5e-7),
    Term(rewards.action_rate, -1.0),
)

RULES = (
    Rule(terminations.success, (1.0 * SECOND,), success=True),
    Rule(terminations.came_apart),
    Rule(terminations.early_takeoff),
    Rule(terminations.wrong_height, (0.10,)),
    Rule(terminations.low_touchdown, (0.20,)),
    Rule(terminations.low_base, (0.10,)),
    Rule(terminations.moved_away, (0.30,)),
    Rule(terminations.slanted_takeoff, (0.75,)),
    Rule(terminations.tilted, (25.0 * DEG,)),
    Rule(terminations.hard_impact, (2.5 * G, 5.0 * G)),
    Rule(terminations.no_jump, (3.0 * SECOND, 1.0 * SECOND)),
    Rule(terminations.collided),
    Rule(terminations.too_long, (20.0 * SECOND,), success=True),
)


def level(lower: float, upper: float, tallest_start: float) -> Level:
    """Return a level with goals between two base heights [m]."""
    return Level((0.0, 0.0, lower), (0.0, 0.0, upper), (0.22, tallest_start))


def vertical_jump() -> TaskCfg:
    """Return the task, with the torque limits of the paper's tests: 18 N m, 10 N m for the lateral motors."""
    return TaskCfg(
        name="vertical-jump",
        observe=observe.observe_vertical,
        columns=("wanted_height", "jump_command", "height"),
        error=jump_errors.height_error,
        terms=TERMS,
        rules=RULES,
        levels=(level(0.5, 0.7, 0.35), level(0.45, 0.95, 0.45), level(0.45, 1.15, 0.45)),
        motors=jumping_motors(18.0, lateral_torque=10.0),
        command_filter=vertical_jump_filter(),
        action_scale=(15.0, 90.0),
        reset=ResetCfg(),
    )
