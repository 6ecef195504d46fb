"""Tasks of both jumps as printed in the paper: observations, rewards, terminations, starts, curriculum, randomisation.

Sources of the constants are at the ends of the lines. P: the paper, with its table or section. A: the authors' public
code. R: our reading, where the paper is silent or contradicts itself. Forms of rewards are those of Tables II and IV;
the paper prints neither their weights nor their widths. `docs/results/paper.md` has the reasons of all readings, and
`docs/results/departures.csv` the values of our own tasks beside these.
"""

from __future__ import annotations

from dataclasses import replace

from jumper_warp.kernels.jump import errors, paper, phase, reset, rewards, terminations
from jumper_warp.kernels.jump import observations as jump
from jumper_warp.kernels.jump.state import JumpState
from jumper_warp.kernels.mdp import observations as obs
from jumper_warp.kernels.mdp import rewards as mdp_rewards
from jumper_warp.kernels.mdp import terminations as mdp_terminations
from jumper_warp.robot.motors import FilterCfg, LimitsCfg, jumping_motors
from jumper_warp.tasks.cfg import ObservationsCfg, Reset, TaskCfg
from jumper_warp.tasks.jump.cfg import JUMP_COMMAND, Level, ResetCfg, StartProbability, cross_levels
from jumper_warp.tasks.jump.evaluation import HeightEvaluation, PlaceEvaluation
from jumper_warp.tasks.observations import PAPER_ROBOT
from jumper_warp.tasks.randomization import PAPER
from jumper_warp.tasks.terms import Advance, Curriculum, ObservationTerm, RewardTerm, TerminationTerm
from jumper_warp.tasks.units import DEG, SECOND, G

LANDING_HEIGHT = 0.30  # [m] of the base, where the ballistic estimate ends (A)

VERTICAL_OBSERVATION = (  # §V-B: h*, c, h, and the robot's observation
    ObservationTerm(jump.wanted_height), ObservationTerm(jump.jump_command), ObservationTerm(obs.height), *PAPER_ROBOT,
)  # fmt: skip
HORIZONTAL_OBSERVATION = (  # §V-C: tracking error in the yaw frame, h, and the robot's observation
    ObservationTerm(jump.way), ObservationTerm(obs.height), *PAPER_ROBOT,
)  # fmt: skip

VERTICAL_REWARDS = (
    # vertical jump rewards (Table IV)
    RewardTerm(paper.jump_height, 20.0, std=0.10, scale=0.05, scale_by_dt=False),  # A
    RewardTerm(paper.estimated_jump_height, 20.0, std=0.10, scale=0.05),  # A
    RewardTerm(rewards.joint_symmetry, 35.0, std_variance=0.04, std_lateral=0.4, waiting_scale=1.0),  # A; widths R
    # common rewards (Table IV)
    RewardTerm(rewards.angular_velocity, 2.0, std=2.0, waiting_scale=1.0),  # A
    RewardTerm(paper.orientation_error, 5.0, std=0.01),  # A; width R: 0.1^2
    RewardTerm(rewards.air_posture, 80.0, std=15.0 * DEG),  # A: desired joint position, in flight
    RewardTerm(paper.landed_posture, 30.0, std=10.0 * DEG, shift=35.0 * DEG),  # A: desired joint position, landed
    RewardTerm(mdp_rewards.ground_force, -0.0005, weight_force=1.0),  # A: -0.002 times the mean over four paws
    RewardTerm(paper.soft_impact, 5.0, limit=5.0 * G),  # A
    RewardTerm(rewards.catch_landing, 3.0),  # A
    RewardTerm(rewards.damp_landing, 10.0),  # A
    # regularisation (Table II)
    RewardTerm(mdp_rewards.action_clip, -1.0),  # A
    RewardTerm(mdp_rewards.motor_torque_sq, -5.0e-4),  # A
    RewardTerm(mdp_rewards.joint_acceleration, -1.5e-7),  # A
    RewardTerm(mdp_rewards.action_rate, -0.1),  # A
    RewardTerm(mdp_rewards.torque_sign_changes, -5.0e-3),  # R: weight of walking; A: 0
)

HORIZONTAL_REWARDS = (
    # horizontal jump rewards (Table IV)
    RewardTerm(paper.tracking, 50.0, std=0.15),  # A
    RewardTerm(paper.estimated_tracking, 100.0, std=0.30, std_wide=0.50, height=LANDING_HEIGHT),  # A
    RewardTerm(rewards.left_right_symmetry, 20.0, std=0.5, waiting_scale=1.0),  # A
    # common rewards (Table IV)
    RewardTerm(rewards.flight_angular_velocity, 4.0, std=10.0),  # A
    RewardTerm(paper.flight_orientation_error, 20.0, std=0.0304617),  # A; width R: (10 degrees)^2
    RewardTerm(rewards.air_posture, 0.0, std=15.0 * DEG),  # A: 0; width of the vertical jump
    RewardTerm(rewards.standing_posture, 50.0, std=20.0 * DEG, shift=25.0 * DEG),  # A: from 0.5 s after touchdown
    RewardTerm(mdp_rewards.ground_force, -0.0005, weight_force=1.0),  # R: weight of the vertical jump; A: none
    RewardTerm(paper.soft_impact, 20.0, limit=5.0 * G),  # A
    RewardTerm(rewards.catch_landing, 20.0),  # A
    RewardTerm(rewards.damp_landing, 25.0),  # A
    # regularisation (Table II)
    RewardTerm(mdp_rewards.action_clip, -2.0),  # A
    RewardTerm(mdp_rewards.motor_torque_sq, -1.0e-5),  # A
    RewardTerm(mdp_rewards.joint_acceleration, -5.0e-7),  # A
    RewardTerm(mdp_rewards.action_rate, -0.03),  # A
    RewardTerm(mdp_rewards.torque_sign_changes, -5.0e-3),  # R: weight of walking; A: 0
)

VERTICAL_TERMINATIONS = (  # kinds: §V-D
    TerminationTerm(terminations.landed_for, name="success", steps=1.0 * SECOND, time_out=True, success=True),  # A
    TerminationTerm(mdp_terminations.diverged),  # A
    TerminationTerm(paper.predicted_height_miss, tolerance=0.225, steps=0.1 * SECOND),  # R
    TerminationTerm(terminations.wrong_height, tolerance=0.10),  # A
    TerminationTerm(terminations.low_touchdown, height=0.20),  # A
    TerminationTerm(mdp_terminations.low_base, height=0.10),  # A
    TerminationTerm(terminations.moved_away, distance=0.20),  # A
    TerminationTerm(terminations.slanted_takeoff, speed=0.75),  # A
    TerminationTerm(mdp_terminations.tilted, angle=25.0 * DEG),  # A
    TerminationTerm(paper.hard_impact, stance=2.5 * G, flight=5.0 * G),  # A
    TerminationTerm(terminations.second_takeoff, speed=0.75),  # A
    TerminationTerm(terminations.no_jump, steps=3.0 * SECOND, idle_steps=1.0 * SECOND),  # A
    TerminationTerm(mdp_terminations.collided),  # P
    TerminationTerm(mdp_terminations.too_long, steps=20.0 * SECOND, time_out=True),  # A
)

HORIZONTAL_TERMINATIONS = (  # kinds: §V-D
    TerminationTerm(terminations.landed_for, name="success", steps=1.0 * SECOND, time_out=True, success=True),  # A
    TerminationTerm(mdp_terminations.diverged),  # A
    TerminationTerm(terminations.predicted_miss, tolerance=0.45, steps=0.1 * SECOND, height=LANDING_HEIGHT),  # A
    TerminationTerm(terminations.missed_goal, tolerance=0.20),  # A
    TerminationTerm(terminations.turned_touchdown, rotation=30.0 * DEG, yaw=10.0 * DEG),  # A
    TerminationTerm(terminations.low_touchdown, height=0.30),  # A
    TerminationTerm(mdp_terminations.low_base, height=0.10),  # A
    TerminationTerm(terminations.left_stance, distance=0.30),  # A
    TerminationTerm(paper.hard_impact, stance=2.5 * G, flight=5.0 * G),  # A
    TerminationTerm(terminations.second_takeoff, speed=0.25),  # A
    TerminationTerm(terminations.no_jump, steps=2.0 * SECOND, idle_steps=0.3 * SECOND),  # A
    TerminationTerm(mdp_terminations.collided),  # P
    TerminationTerm(mdp_terminations.too_long, steps=20.0 * SECOND, time_out=True),  # A
)

VERTICAL_STARTS = ResetCfg(  # kinds: §V-D
    start_probability=StartProbability(standing=0.60, default=0.15, in_flight=0.20, after_landing=0.05),  # A
    balance_by="steps",  # A: of worlds
    base_xy=0.0,  # A
    tilt=1.0,  # A
    forward_pitch=0.0,  # P: horizontal jumps only
    lean=0.0,  # A
    heading=0.0,  # A
    front_x=(0.20, 0.22),  # A
    front_y=(0.15, 0.17),  # A
    back_x=(0.20, 0.22),  # A
    back_y=(0.20, 0.22),  # A
    takeoff_height=(0.40, 0.45),  # A
    takeoff_ahead=(0.0, 0.0),  # A
    takeoff_pitch=(0.0, 0.0),  # A
    landing_height=0.42,  # R: a flight ends at takeoff height
    flight_time=(0.01, 0.95),  # A
    flight_lateral=10.0,  # A
    flight_transversal=(0.0, 90.0),  # A
    landed_height=(0.25, 0.45),  # A
    landed_ahead=(0.0, 0.0),  # A
    landed_speed=(0.0, 0.0),  # A
    command_delay=0.5,  # A
)

HORIZONTAL_STARTS = replace(  # kinds: §V-D
    VERTICAL_STARTS,
    start_probability=StartProbability(
        standing=0.45, default=0.15, in_flight=0.175, touchdown=0.175, after_landing=0.05
    ),  # A
    base_xy=0.05,  # A
    tilt=5.0,  # A
    forward_pitch=10.0,  # P: slight; R
    takeoff_ahead=(0.0, 0.1),  # A
    takeoff_angle=(50.0, 75.0),  # A
    highest_apex=1.0,  # R: within the robot's reach
    landing_height=LANDING_HEIGHT,  # A
    flight_time=(0.02, 0.10),  # A
    flight_transversal=(40.0, 80.0),  # A
    touchdown_time=(0.03, 0.15),  # A
    touchdown_behind=(0.05, 0.20),  # P: paws slightly forward; R
    paw_depth=(0.30, 0.45),  # R: leg lengths
    landed_height=(0.30, 0.50),  # A
    landed_ahead=(-0.15, 0.10),  # A
    command_delay=0.0,  # A
    next_jump_delay=(0.0, 0.7),  # A
)

SQUATS = ((0.22, 0.35), (0.22, 0.45))  # [m] base height of standing starts: deep squats first (§V-D), ranges A
NEXT_JUMP = 0.175  # [1] probability of another goal after a landing (A)

VERTICAL_LEVELS = cross_levels(  # range §VI-A, three levels A, their ranges R
    [Level((0.0, 0.0, 0.6), (0.0, 0.0, top), SQUATS[0]) for top in (0.75, 0.9, 1.1)], SQUATS
)

HORIZONTAL_LEVELS = cross_levels(  # range Fig. 9, four levels A, their ranges R
    (
        Level((0.4, 0.0, 0.0), (0.55, 0.0, 0.0), SQUATS[0]),
        Level((0.4, -0.1, 0.0), (0.7, 0.1, 0.0), SQUATS[0], NEXT_JUMP),
        Level((0.4, -0.2, 0.0), (0.85, 0.2, 0.0), SQUATS[0], NEXT_JUMP),
        Level((0.4, -0.3, 0.0), (1.0, 0.3, 0.0), SQUATS[0], NEXT_JUMP),
    ),
    SQUATS,
)

RANDOMIZATION = replace(
    PAPER,
    static_friction=(0.9, 1.2),  # Table V
    dynamic_friction=(0.8, 0.9),  # Table V
    no_load_speed=(0.8, 1.2),  # Table V
    cutoff_speed=(0.8, 1.4),  # Table V
    motor_friction=(0.005, 0.04),  # Table V; Coulomb friction [N m]: R, A
    latency=(0.0, 16.0),  # Table V: of actions only
    push_force=(-5.0, 5.0),  # Table V
    push_in_flight=False,  # A
)

LATERAL = LimitsCfg(-15.0, 15.0, lower_zone=10.0, upper_zone=15.0)  # A
TRANSVERSAL = LimitsCfg(-30.0, 140.0, lower_zone=10.0, upper_zone=15.0)  # A


def vertical_jump_paper() -> TaskCfg:
    """Return the task of the vertical jump as printed in the paper."""
    return TaskCfg(
        name="vertical-jump-paper",
        state=JumpState,
        advance=Advance(phase.advance_jump, takeoff_speed=0.75),  # A
        reset=Reset(reset.reset_jump, VERTICAL_STARTS, parallel=True),
        command=JUMP_COMMAND,
        curriculum=Curriculum(errors.height_error, tolerance=0.05, promote_after=5, counts=reset.from_standing),  # A
        rewards=VERTICAL_REWARDS,
        terminations=VERTICAL_TERMINATIONS,
        observations=ObservationsCfg(actor=VERTICAL_OBSERVATION, critic=VERTICAL_OBSERVATION),
        levels=VERTICAL_LEVELS,
        motors=jumping_motors(18.0),  # §VI
        command_filter=FilterCfg(LATERAL, TRANSVERSAL, LimitsCfg(0.0, 240.0, 35.0, 45.0), horizon=8.0 / 60.0),  # A
        action_scale=(15.0, 90.0),  # §III
        randomization=RANDOMIZATION,
        reward_floor=0.0,  # A
        evaluation=HeightEvaluation(),
    )


def horizontal_jump_paper() -> TaskCfg:
    """Return the task of the horizontal jump as printed in the paper."""
    return replace(
        vertical_jump_paper(),
        name="horizontal-jump-paper",
        advance=Advance(phase.advance_jump, takeoff_speed=0.25),  # A
        reset=Reset(reset.reset_jump, HORIZONTAL_STARTS, parallel=True),
        curriculum=Curriculum(errors.landing_error, tolerance=0.10, promote_after=5, counts=reset.from_standing),  # A
        rewards=HORIZONTAL_REWARDS,
        terminations=HORIZONTAL_TERMINATIONS,
        observations=ObservationsCfg(actor=HORIZONTAL_OBSERVATION, critic=HORIZONTAL_OBSERVATION),
        levels=HORIZONTAL_LEVELS,
        command_filter=FilterCfg(LATERAL, TRANSVERSAL, LimitsCfg(0.0, 220.0, 30.0, 30.0), horizon=8.0 / 60.0),  # A
        reward_floor=None,  # A
        evaluation=PlaceEvaluation(),
    )
