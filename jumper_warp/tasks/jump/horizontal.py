"""Tasks of horizontal jumps: jump to a goal position in the plane, then stand there.

Terms and constants are based on the paper and its authors' code. `docs/results/departures.csv` has all differences and
their reasons; `paper.py` is the paper's own task.
"""

from __future__ import annotations

from dataclasses import replace

from jumper_warp.kernels.jump import errors, phase, reset, rewards, terminations
from jumper_warp.kernels.jump.state import JumpState
from jumper_warp.kernels.mdp import rewards as mdp_rewards
from jumper_warp.kernels.mdp import terminations as mdp_terminations
from jumper_warp.robot.motors import horizontal_jump_filter, jumping_motors
from jumper_warp.tasks.cfg import ObservationsCfg, Reset, TaskCfg
from jumper_warp.tasks.jump.cfg import JUMP_COMMAND, GroundCfg, Level, ResetCfg, StartProbability, cross_levels
from jumper_warp.tasks.jump.evaluation import PlaceEvaluation
from jumper_warp.tasks.jump.observations import HORIZONTAL, SIGHT, SIGHTED, critic
from jumper_warp.tasks.jump.vertical import QUIET, STARTS
from jumper_warp.tasks.observations import remembered
from jumper_warp.tasks.terms import Advance, Curriculum, RewardTerm, TerminationTerm
from jumper_warp.tasks.units import DEG, SECOND, G

LANDING_HEIGHT = 0.30  # [m] of the base, at which the ballistic estimate ends

REWARDS = (
    RewardTerm(rewards.tracking, 50.0, std_wide=0.15, std_fine=0.03, fine_weight=0.6),
    RewardTerm(rewards.estimated_tracking, 100.0, std_middle=0.30, std_wide=0.50, std_fine=0.10, height=LANDING_HEIGHT),
    RewardTerm(rewards.flight_orientation, 20.0, std=10.0 * DEG),
    RewardTerm(rewards.orientation, 15.0, std=0.15, waiting_scale=0.1),
    RewardTerm(rewards.flight_angular_velocity, 4.0, std=10.0),
    RewardTerm(rewards.left_right_symmetry, 20.0, std=0.5, waiting_scale=0.1),
    RewardTerm(rewards.standing_posture, 50.0, std=20.0 * DEG, shift=25.0 * DEG),
    RewardTerm(rewards.base_at_rest, 40.0, std_lin_vel=0.1, std_ang_vel=0.5),
    RewardTerm(rewards.landing_tilt, -60.0, angle=10.0 * DEG),
    RewardTerm(rewards.descent_tilt, -60.0, angle=10.0 * DEG),
    RewardTerm(rewards.lifted_again, -30.0, threshold=0.0),
    RewardTerm(rewards.capture_point, 20.0, std=0.10),
    RewardTerm(rewards.soft_impact, 20.0, limit=5.0 * G),
    RewardTerm(rewards.catch_landing, 20.0),
    RewardTerm(rewards.damp_landing, 25.0),
    RewardTerm(mdp_rewards.ground_force, -0.5, weight_force=14.5 * G),
    RewardTerm(mdp_rewards.action_clip, -2.0),
    RewardTerm(mdp_rewards.motor_torque_sq, -1.0e-5),
    RewardTerm(mdp_rewards.joint_acceleration, -5.0e-7),
    RewardTerm(mdp_rewards.action_rate, -1.0),
    *QUIET,
)

TERMINATIONS = (
    TerminationTerm(terminations.landed_for, name="success", steps=1.0 * SECOND, time_out=True, success=True),
    TerminationTerm(mdp_terminations.diverged),
    TerminationTerm(terminations.early_takeoff),
    TerminationTerm(terminations.predicted_miss, tolerance=0.55, steps=0.1 * SECOND, height=LANDING_HEIGHT),
    TerminationTerm(terminations.missed_goal, tolerance=0.50),
    TerminationTerm(terminations.turned_touchdown, rotation=20.0 * DEG, yaw=10.0 * DEG),
    TerminationTerm(terminations.low_touchdown, height=0.25),
    TerminationTerm(mdp_terminations.low_base, height=0.10),
    TerminationTerm(terminations.left_stance, distance=0.30),
    TerminationTerm(terminations.hard_impact, stance=2.5 * G, flight=5.0 * G),
    TerminationTerm(terminations.second_takeoff, speed=0.25),
    TerminationTerm(terminations.no_jump, steps=2.0 * SECOND, idle_steps=0.3 * SECOND),
    TerminationTerm(mdp_terminations.collided),
    TerminationTerm(mdp_terminations.too_long, steps=20.0 * SECOND, time_out=True),
)

NEXT_JUMP_PROBABILITY = 0.175  # [1] of another goal after a landing, above the first level

RESET = ResetCfg(
    start_probability=StartProbability(
        standing=0.40, default=0.15, in_flight=0.15, touchdown=0.15, after_landing=0.05, pushing=0.10
    ),
    balance_by="steps",
    forward_pitch=10.0,
    lean=0.20,
    heading=180.0,
    takeoff_ahead=(0.0, 0.35),
    takeoff_pitch=(0.0, 15.0),
    takeoff_angle=(35.0, 75.0),
    landing_height=LANDING_HEIGHT,
    flight_time=(0.02, 0.10),
    flight_transversal=(40.0, 80.0),
    touchdown_behind=(0.05, 0.20),
    landed_height=(0.30, 0.45),
    landed_ahead=(-0.15, 0.10),
    ground=GroundCfg(platform=0.35, block=0.25),
)


def level(x: tuple[float, float], y: float, next_jump_probability: float = NEXT_JUMP_PROBABILITY) -> Level:
    """Return a curriculum level with goals x = (lower, upper) [m] ahead and up to y [m] to either side.

    Standing starts are those of `STARTS[0]`, until `cross_levels` replaces them.
    """
    return Level((x[0], -y, 0.0), (x[1], y, 0.0), STARTS[0], next_jump_probability)


NEAREST = level((0.2, 0.5), 0.0, next_jump_probability=0.0)  # First level of every curriculum of goal positions


def horizontal_jump() -> TaskCfg:
    """Return the task of a jump to a place ahead; torque limits are 18 N m, for lateral motors the paper's 12 N m."""
    return TaskCfg(
        name="horizontal-jump",
        state=JumpState,
        advance=Advance(phase.advance_jump, takeoff_speed=0.25),
        reset=Reset(reset.reset_jump, RESET, parallel=True),
        command=JUMP_COMMAND,
        curriculum=Curriculum(errors.landing_error, tolerance=0.10, counts=reset.from_standing),
        rewards=REWARDS,
        terminations=TERMINATIONS,
        observations=ObservationsCfg(actor=remembered(HORIZONTAL), critic=critic(HORIZONTAL, SIGHT)),
        levels=cross_levels(
            (
                NEAREST,
                level((0.25, 0.8), 0.15),
                level((0.3, 1.1), 0.3),
                level((0.3, 1.5), 0.35),
                level((0.3, 1.9), 0.35),
                level((0.3, 2.2), 0.35),
            ),
            STARTS,
        ),
        motors=jumping_motors(18.0, lateral_torque=12.0),
        command_filter=horizontal_jump_filter(),
        action_scale=(15.0, 90.0),
        self_collision_margin=0.005,
        evaluation=PlaceEvaluation(),
    )


def horizontal_jump_sighted() -> TaskCfg:
    """Return the task of a horizontal jump in which the policy observes edges and height of the block ahead."""
    task = horizontal_jump()
    ground = replace(RESET.ground, platform=0.30, block=0.45)
    return replace(
        task,
        name="horizontal-jump-sighted",
        observations=ObservationsCfg(actor=remembered(SIGHTED), critic=critic(SIGHTED)),
        reset=replace(task.reset, settings=replace(RESET, ground=ground)),
    )
