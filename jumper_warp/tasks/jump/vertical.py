"""Task of a vertical jump: reach a commanded apex height of the base, then land.

Terms and constants are based on the paper and its authors' code. `docs/results/departures.csv` has all differences and
their reasons; `paper.py` is the paper's own task.
"""

from __future__ import annotations

from jumper_warp.kernels.jump import errors, phase, reset, rewards, terminations
from jumper_warp.kernels.jump.state import JumpState
from jumper_warp.kernels.mdp import rewards as mdp_rewards
from jumper_warp.kernels.mdp import terminations as mdp_terminations
from jumper_warp.robot.motors import jumping_motors, vertical_jump_filter
from jumper_warp.tasks.cfg import ObservationsCfg, Reset, TaskCfg
from jumper_warp.tasks.jump.cfg import JUMP_COMMAND, Level, ResetCfg, StartProbability, cross_levels
from jumper_warp.tasks.jump.evaluation import HeightEvaluation
from jumper_warp.tasks.jump.observations import VERTICAL, critic
from jumper_warp.tasks.observations import remembered
from jumper_warp.tasks.terms import Advance, Curriculum, RewardTerm, TerminationTerm
from jumper_warp.tasks.units import DEG, SECOND, G

WAITING_SCALE = 0.1  # [1] factor on the terms of all phases from the jump command to the takeoff
TAKEOFF_SPEED = 0.75  # [m/s] smallest upward speed of a takeoff; a second takeoff ends the episode

QUIET = (
    RewardTerm(rewards.resting_action_rate, -2.0),
    RewardTerm(rewards.torque_ripple, -0.01),
    RewardTerm(rewards.force_ripple, -5.0, weight_force=14.5 * G),
)
"""Penalties of motion while standing before the command and after the landing."""

REWARDS = (
    RewardTerm(rewards.jump_height, 40.0, std_fine=0.10, scale_sharp=0.05, std_wide=0.4, scale_by_dt=False),
    RewardTerm(rewards.estimated_jump_height, 20.0, std_fine=0.10, scale_sharp=0.05, std_wide=0.4),
    RewardTerm(rewards.horizontal_velocity, 10.0, speed_scale=0.04, waiting_scale=WAITING_SCALE),
    RewardTerm(rewards.orientation, 15.0, std=0.1, waiting_scale=WAITING_SCALE),
    RewardTerm(rewards.angular_velocity, 2.0, std=2.0, waiting_scale=WAITING_SCALE),
    RewardTerm(rewards.joint_symmetry, 35.0, std_variance=0.05, std_lateral=0.35, waiting_scale=WAITING_SCALE),
    RewardTerm(rewards.ground_posture, 10.0, std=10.0 * DEG, shift=35.0 * DEG, waiting_scale=WAITING_SCALE),
    RewardTerm(rewards.air_posture, 80.0, std=15.0 * DEG),
    RewardTerm(rewards.post_landing_posture, 10.0, std=15.0 * DEG, shift=15.0 * DEG),
    RewardTerm(rewards.base_at_rest, 20.0, std_lin_vel=0.1, std_ang_vel=0.5),
    RewardTerm(rewards.landing_tilt, -120.0, angle=10.0 * DEG),
    RewardTerm(rewards.paws_down, 30.0),
    RewardTerm(rewards.soft_impact, 5.0, limit=5.0 * G),
    RewardTerm(rewards.stance_impact, 100.0, limit=2.5 * G),
    RewardTerm(rewards.catch_landing, 3.0),
    RewardTerm(rewards.damp_landing, 10.0),
    RewardTerm(mdp_rewards.ground_force, -0.5, weight_force=14.5 * G),
    RewardTerm(mdp_rewards.action_clip, -1.0),
    RewardTerm(mdp_rewards.motor_torque_sq, -5.0e-4),
    RewardTerm(mdp_rewards.joint_acceleration, -1.5e-7),
    RewardTerm(mdp_rewards.action_rate, -1.0),
    *QUIET,
)

TERMINATIONS = (
    TerminationTerm(terminations.landed_for, name="success", steps=1.0 * SECOND, time_out=True, success=True),
    TerminationTerm(mdp_terminations.diverged),
    TerminationTerm(terminations.early_takeoff),
    TerminationTerm(terminations.wrong_height, tolerance=0.10),
    TerminationTerm(terminations.low_touchdown, height=0.20),
    TerminationTerm(mdp_terminations.low_base, height=0.10),
    TerminationTerm(terminations.moved_away, distance=0.30),
    TerminationTerm(terminations.slanted_takeoff, speed=0.75),
    TerminationTerm(mdp_terminations.tilted, angle=25.0 * DEG),
    TerminationTerm(terminations.hard_impact, stance=2.5 * G, flight=5.0 * G),
    TerminationTerm(terminations.second_takeoff, speed=TAKEOFF_SPEED),
    TerminationTerm(terminations.no_jump, steps=3.0 * SECOND, idle_steps=1.0 * SECOND),
    TerminationTerm(mdp_terminations.collided),
    TerminationTerm(mdp_terminations.too_long, steps=20.0 * SECOND, time_out=True),
)

STARTS = ((0.22, 0.35), (0.22, 0.45))  # [m] base heights of standing starts by level, easiest (deep squats) first

RESET = ResetCfg(
    start_probability=StartProbability(0.50, default=0.15, in_flight=0.20, after_landing=0.05, pushing=0.10),
    balance_by="steps",
)


def heights(*pairs: tuple[float, float]) -> tuple[Level, ...]:
    """Return curriculum levels that combine each given range of apex heights [m] with each range of start heights."""
    return cross_levels([Level((0.0, 0.0, low), (0.0, 0.0, high), STARTS[0]) for low, high in pairs], STARTS)


def vertical_jump() -> TaskCfg:
    """Return the task of a vertical jump with torque limits of 18 N m (lateral motors: 10 N m, as the authors')."""
    return TaskCfg(
        name="vertical-jump",
        state=JumpState,
        advance=Advance(phase.advance_jump, takeoff_speed=TAKEOFF_SPEED),
        reset=Reset(reset.reset_jump, RESET, parallel=True),
        command=JUMP_COMMAND,
        curriculum=Curriculum(errors.height_error, tolerance=0.05, counts=reset.from_standing),
        rewards=REWARDS,
        terminations=TERMINATIONS,
        observations=ObservationsCfg(actor=remembered(VERTICAL), critic=critic(VERTICAL)),
        levels=heights((0.5, 0.7), (0.45, 0.95), (0.45, 1.15)),
        motors=jumping_motors(18.0, lateral_torque=10.0),
        command_filter=vertical_jump_filter(),
        action_scale=(15.0, 90.0),
        self_collision_margin=0.005,
        evaluation=HeightEvaluation(),
    )
