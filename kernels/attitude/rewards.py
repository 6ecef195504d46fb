"""Reward terms of turning in free flight."""

import warp as wp

from ..mdp.rewards import phi, posture_offset
from ..mdp.view import RobotView
from .state import POLICY_RATE, AttitudeState


@wp.func
def approach(robot: RobotView, state: AttitudeState) -> float:
    """Reward for turning toward the goal orientation. It is the decrease of the angle to it per second [rad/s]."""
    return (state.old_error - state.error) * POLICY_RATE


@wp.func
def attitude(robot: RobotView, state: AttitudeState, std: float) -> float:
    """Reward for an orientation close to the goal, 1 at the goal.

    It is `phi` of the angle to it, of width std [rad].
    """
    return phi(state.error, std)


@wp.func
def hold(robot: RobotView, state: AttitudeState, std: float, std_ang_vel: float) -> float:
    """Reward for resting at the goal orientation, at most 1.

    It is phi(angle to the goal; std [rad]) times phi(angular speed; std_ang_vel [rad/s]).
    """
    return phi(state.error, std) * phi(wp.length(robot.ang_vel), std_ang_vel)


@wp.func
def landing_posture(robot: RobotView, state: AttitudeState, std: float, std_posture: float) -> float:
    """Reward for holding the legs in the default pose at the goal orientation, ready for landing.

    It is phi(angle to the goal; std [rad]) times phi(rms motor offset from default; std_posture [rad]).
    """
    return phi(state.error, std) * phi(posture_offset(robot, 0.0), std_posture)


@wp.func
def spin(robot: RobotView, state: AttitudeState) -> float:
    """Penalty of rotation of the base. It is its squared angular speed [rad^2/s^2]."""
    return wp.length_sq(robot.ang_vel)
