"""Turning in free flight: a floating robot moves its legs so that its base reaches a commanded orientation.

No force acts, so angular momentum stays zero: the base turns while legs move. It stays turned after a closed cycle in
which the legs are stretched on the way out and folded on the way back. Weights and limits are of the order of those in
the authors' sequel (attitude wide and narrow 2.5 and 1.5, collision -100, 8 N m), which does not publish the terms.
`approach` rewards every degree of progress, also far from the goal, where the other kernels are flat. A collision costs
reward and makes the episode a failure, but does not end it, since legs collide in every episode early in training.
"""

from __future__ import annotations

from jumper_warp.kernels.attitude import observations as attitude
from jumper_warp.kernels.attitude import rewards, state, terminations
from jumper_warp.kernels.attitude.commands import set_turn
from jumper_warp.kernels.attitude.reset import reset_attitude
from jumper_warp.kernels.attitude.state import AttitudeState
from jumper_warp.kernels.mdp import rewards as mdp_rewards
from jumper_warp.kernels.mdp import terminations as mdp_terminations
from jumper_warp.robot.motors import jumping_motors, walking_filter
from jumper_warp.tasks.attitude.cfg import AttitudeEvaluation, AttitudeResetCfg, TurnCfg
from jumper_warp.tasks.cfg import Command, ObservationsCfg, Reset, TaskCfg
from jumper_warp.tasks.observations import DRAWN, ROBOT, exact
from jumper_warp.tasks.randomization import RandomizationCfg
from jumper_warp.tasks.terms import Advance, Curriculum, ObservationTerm, RewardTerm, StateMetric, TerminationTerm
from jumper_warp.tasks.units import DEG

TORQUE = 8.0  # [N m] limit of all motors
TOLERANCE = 5.0  # [deg] largest orientation error of a robot that has reached its goal

ACTOR = (
    ObservationTerm(attitude.turn_left, noise=0.02),
    *(term for term in ROBOT if term.name not in ("lin_vel", "gravity")),
)
"""Policy observation: rotation to the goal, angular velocity, motors and last action."""

CRITIC = (
    *exact(ACTOR),
    ObservationTerm(attitude.time_left),
    ObservationTerm(attitude.in_collision),
    *(term for term in DRAWN if term.name not in ("drawn_friction", "drawn_push")),
)
"""Critic observation: the actor's without noise, plus privileged values."""

REWARDS = (
    RewardTerm(rewards.approach, 15.0),
    RewardTerm(rewards.attitude, 2.5, name="attitude_wide", std=60.0 * DEG),
    RewardTerm(rewards.attitude, 1.5, name="attitude_narrow", std=10.0 * DEG),
    RewardTerm(rewards.attitude, 1.0, name="attitude_fine", std=3.0 * DEG),
    RewardTerm(rewards.hold, 2.0, std=10.0 * DEG, std_ang_vel=0.5),
    RewardTerm(rewards.landing_posture, 1.0, std=15.0 * DEG, std_posture=30.0 * DEG),
    RewardTerm(rewards.spin, -0.01),
    RewardTerm(mdp_rewards.collision, -20.0),
    RewardTerm(mdp_rewards.action_clip, -0.1),
    RewardTerm(mdp_rewards.motor_torque_sq, -5.0e-4),
    RewardTerm(mdp_rewards.joint_acceleration, -1.0e-7),
    RewardTerm(mdp_rewards.action_rate, -0.02),
)

TERMINATIONS = (
    TerminationTerm(mdp_terminations.diverged),
    TerminationTerm(terminations.ended_clear, time_out=True, success=True),
    TerminationTerm(terminations.ended, time_out=True),
)

METRICS = (
    StateMetric("Metrics/error_at_end_rad", "sum_error", "episodes"),
    StateMetric("Metrics/settled", "settled", "episodes"),
    StateMetric("Metrics/settling_time_of_settled_s", "sum_settling", "settled"),
    StateMetric("Metrics/in_collision_s", "sum_collisions", "episodes"),
)


def attitude_in_flight() -> TaskCfg:
    """Return the task of turning in zero gravity, with motors limited to 8 N m and the legs' full range of motion."""
    return TaskCfg(
        name="attitude",
        state=AttitudeState,
        advance=Advance(state.advance_attitude, tolerance=TOLERANCE * DEG),
        reset=Reset(reset_attitude, AttitudeResetCfg(), parallel=True),
        command=Command(set_turn, labels=tuple(f"quaternion {axis} [1]" for axis in "xyzw"), nonzero=True),
        curriculum=Curriculum(
            state.attitude_error, tolerance=10.0 * DEG, promote_after=5, counts=state.every_episode, unit="rad"
        ),
        levels=(TurnCfg((5.0, 40.0)), TurnCfg((10.0, 70.0)), TurnCfg((20.0, 100.0)), TurnCfg((20.0, 140.0))),
        rewards=REWARDS,
        terminations=TERMINATIONS,
        observations=ObservationsCfg(actor=ACTOR, critic=CRITIC),
        motors=jumping_motors(TORQUE),
        command_filter=walking_filter(),
        action_scale=(90.0, 90.0),
        randomization=RandomizationCfg(push_force=None, push_torque=None),
        gravity=0.0,
        keep_momentum=True,
        eval_height_offset=2.0,
        reward_floor=None,
        metrics=METRICS,
        evaluation=AttitudeEvaluation(),
    )
