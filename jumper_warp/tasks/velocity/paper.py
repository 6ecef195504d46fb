"""Task of walking as printed in the paper: observation, rewards, terminations, start states and randomisation.

Sources of the constants are at the ends of the lines. P: the paper, with its table or section. A: the authors' public
code. R: our reading, where the paper is silent or contradicts itself. Forms of rewards are those of Tables II and III;
the paper prints neither their weights nor their widths. `docs/results/paper.md` has the reasons of all readings, and
`docs/results/departures.csv` the values of our own task beside these.
"""

from __future__ import annotations

from dataclasses import replace

from jumper_warp.kernels.mdp import rewards as mdp_rewards
from jumper_warp.kernels.mdp import terminations as mdp_terminations
from jumper_warp.kernels.velocity import observations as velocity
from jumper_warp.kernels.velocity import rewards, state, terminations
from jumper_warp.kernels.velocity.reset import reset_velocity
from jumper_warp.kernels.velocity.state import VelocityState
from jumper_warp.robot.motors import FilterCfg, LimitsCfg, walking_motors
from jumper_warp.tasks.cfg import ObservationsCfg, Reset, TaskCfg
from jumper_warp.tasks.observations import PAPER_ROBOT
from jumper_warp.tasks.randomization import PAPER
from jumper_warp.tasks.terms import Advance, Curriculum, ObservationTerm, RewardTerm, TerminationTerm
from jumper_warp.tasks.units import DEG, SECOND
from jumper_warp.tasks.velocity.cfg import VELOCITY_COMMAND, CommandCfg, VelocityEvaluation, VelocityResetCfg
from jumper_warp.tasks.velocity.flat import METRICS, SENSED

SENSES = tuple(term.replace(delayed=term.name in SENSED) for term in PAPER_ROBOT)  # latency of sensors (§V-F)
OBSERVATION = (*SENSES[:3], ObservationTerm(velocity.command), *SENSES[3:])  # §V-A

REWARDS = (
    # walking rewards (Table III)
    RewardTerm(rewards.linear_velocity, 2.5, std=0.5),  # A
    RewardTerm(rewards.yaw_rate, 1.5, std=0.5),  # A
    RewardTerm(rewards.lin_vel_z_l2, -1.0),  # A
    RewardTerm(rewards.ang_vel_xy_l2, -0.03),  # A
    RewardTerm(rewards.flat_orientation_l2, -50.0),  # A
    RewardTerm(rewards.standing_posture, 1.5, std=10.0 * DEG, shift=10.0 * DEG),  # A
    RewardTerm(rewards.lateral_position, 0.18, steepness=100.0),  # A
    RewardTerm(rewards.transversal_position, 0.1, steepness=5000.0, shift=10.0 * DEG),  # A
    # longer steps, lower gait frequency, collisions (§V-A)
    RewardTerm(rewards.air_time, 0.5, threshold=0.25),  # A
    RewardTerm(rewards.clamped_rapid_stepping, -0.15, threshold=2.0, limit=5.0),  # A
    RewardTerm(mdp_rewards.collision, -100.0),  # A
    # regularisation (Table II)
    RewardTerm(mdp_rewards.action_clip, -1.0e-3),  # A
    RewardTerm(mdp_rewards.motor_torque_sq, -1.5e-5),  # A, where it is overwritten with 0
    RewardTerm(mdp_rewards.joint_acceleration, -5.0e-7),  # A, where it is overwritten with 0
    RewardTerm(mdp_rewards.action_rate, -0.06),  # A, where it is overwritten with 0
    RewardTerm(mdp_rewards.torque_sign_changes, -5.0e-3),  # A
)

TERMINATIONS = (
    TerminationTerm(mdp_terminations.diverged),  # A
    TerminationTerm(mdp_terminations.collided),  # A; P: of the base
    TerminationTerm(terminations.finished, time_out=True, success=True),  # A
)

STARTS = VelocityResetCfg(  # §V-A: random base poses and paw positions
    episode=20.0,  # A
    default_pose_probability=0.0,  # A
    base_xy=0.1,  # A
    height=(0.30, 0.50),  # A
    tilt=5.0,  # A
    heading=180.0,  # A
    front_x=(0.20, 0.22),  # A
    front_y=(0.15, 0.17),  # A
    back_x=(0.20, 0.22),  # A
    back_y=(0.20, 0.22),  # A
    swing_probability=0.0,  # A
    lin_vel=0.0,  # A
    ang_vel=0.0,  # A
)

COMMANDS = CommandCfg(
    first_range=(0.75, 0.75, 0.75, 0.75),  # A
    last_range=(0.75, 0.75, 0.75, 0.75),  # A
    levels=0,  # A
    smallest=0.12,  # A
    standing_probability=0.12,  # A
    turn_in_place_probability=0.05,  # A
    resampling_time_range=(10.0, 15.0),  # A
)

RANDOMIZATION = replace(
    PAPER,
    static_friction=(0.8, 0.95),  # Table V
    dynamic_friction=(0.7, 0.8),  # Table V
    no_load_speed=(0.6, 1.2),  # Table V
    cutoff_speed=(0.6, 1.4),  # Table V
    motor_friction=(0.0, 0.04),  # Table V; Coulomb friction [N m]: R, A
    latency=(0.0, 32.0),  # Table V
    observation_latency=(0.0, 32.0),  # Table V
    push_force=(-10.0, 10.0),  # Table V
    push_in_flight=True,  # A
)


def velocity_paper() -> TaskCfg:
    """Return the task of velocity tracking as printed in the paper."""
    return TaskCfg(
        name="velocity-paper",
        state=VelocityState,
        advance=Advance(state.advance_velocity, settle=1.0 * SECOND),  # for metrics
        reset=Reset(reset_velocity, STARTS, parallel=True),
        command=VELOCITY_COMMAND,
        curriculum=Curriculum(
            state.tracking_error, tolerance=0.18, promote_after=1_000_000, counts=state.every_episode, unit="m_s"
        ),  # for metrics: the paper has none
        rewards=REWARDS,
        terminations=TERMINATIONS,
        observations=ObservationsCfg(actor=OBSERVATION, critic=OBSERVATION),
        levels=(COMMANDS,),
        motors=walking_motors(18.0),  # §VII
        command_filter=FilterCfg(
            LimitsCfg(-50.0, 110.0), LimitsCfg(-30.0, 140.0), sum=LimitsCfg(0.0, 220.0), horizon=5.0 / 60.0
        ),  # A; the upper lateral limit is the robot's hard stop (A: 180)
        action_scale=(60.0, 60.0),  # §III
        randomization=RANDOMIZATION,
        reward_floor=0.0,  # A
        metrics=METRICS,
        evaluation=VelocityEvaluation(),
    )
