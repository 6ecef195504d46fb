"""Velocity tracking on a plane: walk ahead, back and sideways, and turn, as commanded.

Terms and constants are based on the paper and its authors' code, with these exceptions (`paper.py` is the paper's own
task). Tracking
terms have second, narrow kernels, since the wide ones are flat at errors of a few cm/s. Air time has sixteen times the
weight, which makes the robot trot without short quick steps. The penalty of rapid stepping grows linearly, since the
clamped exponential has no slope at the start of training. Swing height, slip and touchdown speed have terms. Torques,
joint accelerations and changes of the action are penalised (the configuration lists these weights but sets them to 0).
Second differences of the action, which distinguish chatter from walking, are penalised too. Commands are resampled
every few seconds, so that policies learn transients, and their range grows with the tracking score. The narrow reward
of turning pays only robots near the commanded velocity, or some learn to turn on the spot and never to walk.
"""

from __future__ import annotations

from dataclasses import replace

from jumper_warp.kernels.mdp import observations as obs
from jumper_warp.kernels.mdp import rewards as mdp_rewards
from jumper_warp.kernels.mdp import terminations as mdp_terminations
from jumper_warp.kernels.velocity import observations as velocity
from jumper_warp.kernels.velocity import rewards, state, terminations
from jumper_warp.kernels.velocity.reset import reset_velocity
from jumper_warp.kernels.velocity.state import VelocityState
from jumper_warp.robot.motors import walking_filter, walking_motors
from jumper_warp.tasks.cfg import ObservationsCfg, Reset, TaskCfg
from jumper_warp.tasks.observations import DRAWN, ROBOT, exact, remembered
from jumper_warp.tasks.randomization import RandomizationCfg
from jumper_warp.tasks.terms import Advance, Curriculum, ObservationTerm, RewardTerm, StateMetric, TerminationTerm
from jumper_warp.tasks.units import DEG, SECOND
from jumper_warp.tasks.velocity.cfg import VELOCITY_COMMAND, CommandCfg, VelocityEvaluation, VelocityResetCfg

SENSED = ("lin_vel", "ang_vel", "gravity", "angle", "rate")  # Names of the terms with observation latency

WITHOUT_HISTORY = (ObservationTerm(velocity.command), *(term.replace(delayed=term.name in SENSED) for term in ROBOT))
"""Observation of the paper's walking policy, in another order."""

ACTOR = remembered(WITHOUT_HISTORY)  # Policy observation: `WITHOUT_HISTORY` over four policy steps

CRITIC = (
    *exact(WITHOUT_HISTORY),
    ObservationTerm(obs.height),
    ObservationTerm(obs.contacts),
    ObservationTerm(obs.air_times),
    ObservationTerm(velocity.contact_times),
    ObservationTerm(velocity.paw_heights),
    ObservationTerm(velocity.recent_steps),
    ObservationTerm(velocity.command_age),
    ObservationTerm(obs.paw_forces),
    ObservationTerm(velocity.push),
    *(term for term in DRAWN if term.func is not obs.drawn_push),  # in world axes, whatever the heading
)
"""Critic observation: the actor's without noise and delay, plus privileged values."""

REWARDS = (
    RewardTerm(rewards.linear_velocity, 2.5, std=0.5),
    RewardTerm(rewards.linear_velocity, 2.0, name="linear_velocity_fine", std=0.1),
    RewardTerm(rewards.yaw_rate, 1.5, std=0.5),
    RewardTerm(rewards.yaw_rate_on_course, 4.3, name="yaw_rate_fine", std=0.1, std_lin_vel=0.5),
    RewardTerm(rewards.lin_vel_z_l2, -1.0),
    RewardTerm(rewards.ang_vel_xy_l2, -0.1),
    RewardTerm(rewards.flat_orientation_l2, -50.0),
    RewardTerm(rewards.standing_posture, 1.5, std=10.0 * DEG),
    RewardTerm(rewards.restless_stand, -0.2),
    RewardTerm(rewards.lateral_position, 0.18, steepness=100.0),
    RewardTerm(rewards.transversal_position, 0.1, steepness=5000.0, shift=10.0 * DEG),
    RewardTerm(rewards.air_time, 6.8, threshold=0.25),
    RewardTerm(rewards.rapid_stepping, -0.27, threshold=2.0),
    RewardTerm(rewards.foot_clearance, -45.0, target_height=0.063),
    RewardTerm(rewards.slip, -0.25),
    RewardTerm(rewards.touchdown, -1.0),
    RewardTerm(mdp_rewards.action_clip, -1.0e-3),
    RewardTerm(mdp_rewards.motor_torque_sq, -1.0e-4),
    RewardTerm(mdp_rewards.joint_acceleration, -2.0e-7),
    RewardTerm(mdp_rewards.action_rate, -0.08),
    RewardTerm(mdp_rewards.action_acceleration, -0.03),
    RewardTerm(mdp_rewards.torque_sign_changes, -5.0e-3),
)

TERMINATIONS = (
    TerminationTerm(mdp_terminations.diverged),
    TerminationTerm(mdp_terminations.collided),
    TerminationTerm(mdp_terminations.tilted, angle=60.0 * DEG),
    TerminationTerm(terminations.finished, time_out=True, success=True),
    TerminationTerm(terminations.left_map, time_out=True),
)

METRICS = (
    StateMetric("Metrics/score", "score", "all_steps"),
    StateMetric("Metrics/error_vel_xy_settled_m_s", "sum_xy", "sum_settled"),
    StateMetric("Metrics/error_vel_yaw_settled_rad_s", "sum_yaw", "sum_settled"),
    StateMetric("Metrics/falls_per_minute", "falls", "minutes"),
    StateMetric("Metrics/swing_apex_m", "apexes", "touchdowns"),
    StateMetric("Metrics/steps_hz", "touchdowns", "seconds_walking"),
    StateMetric("Curriculum/command_level", "command_level"),
    StateMetric("Curriculum/terrain_level", "terrain_level"),
)


def velocity_flat() -> TaskCfg:
    """Return the task of velocity tracking on a plane, with gains and torque limit (10 N m) of the authors' code."""
    return TaskCfg(
        name="velocity-flat",
        state=VelocityState,
        advance=Advance(state.advance_velocity, settle=1.0 * SECOND),
        reset=Reset(reset_velocity, VelocityResetCfg(), parallel=True),
        command=VELOCITY_COMMAND,
        curriculum=Curriculum(
            state.tracking_error, tolerance=0.18, promote_after=1_000_000, counts=state.every_episode, unit="m_s"
        ),
        rewards=REWARDS,
        terminations=TERMINATIONS,
        observations=ObservationsCfg(actor=ACTOR, critic=CRITIC),
        levels=(CommandCfg(),),
        motors=walking_motors(),
        command_filter=walking_filter(),
        action_scale=(60.0, 60.0),
        randomization=RandomizationCfg.walking(),
        metrics=METRICS,
        evaluation=VelocityEvaluation(),
    )


def velocity_trot() -> TaskCfg:
    """Return the task of velocity tracking on a plane with an observed 2 Hz gait clock and a reward for trotting."""
    flat = velocity_flat()
    gait_phase = ObservationTerm(velocity.gait_phase)
    return replace(
        flat,
        name="velocity-trot",
        reset=replace(flat.reset, settings=replace(flat.reset.settings, gait=2.0)),
        rewards=(*flat.rewards, RewardTerm(rewards.trot_schedule, 2.0, duty=0.55)),
        observations=ObservationsCfg(
            actor=(*flat.observations.actor, gait_phase), critic=(*flat.observations.critic, gait_phase)
        ),
    )
