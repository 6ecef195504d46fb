"""Reward terms of turning in free flight."""

import warp as wp

from ..mdp.rewards import phi, posture_offset
from ..mdp.view import RobotView
from .state import POLICY_RATE, AttitudeState


@wp.func
def approach(robot: RobotView, state: AttitudeState) -> float:
    """Approach: how fast the angle to the goal falls [rad/s]."""
    return (state.old_error - state.error) * POLICY_RATE


@wp.func
def attitude(robot: RobotView, state: AttitudeState, width: float) -> float:
    """Attitude: phi of the angle to the goal; width [rad]."""
    return phi(state.error, width)


@wp.func
def hold(robot: RobotView, state: AttitudeState, width: float, spin: float) -> float:
    """Hold: at the goal, not turning; phi of the angle, width [rad], times phi of the angular speed, spin [rad/s]."""
    return phi(state.error, width) * phi(wp.length(robot.ang_vel), spin)


@wp.func
def landing_posture(robot: RobotView, state: AttitudeState, width: float, posture: float) -> float:
    """Landing posture: at the goal and near the default pose; phi of the angle, width [rad], and of the rms offset of
    the motors, posture [rad]."""
    return phi(state.error, width) * phi(posture_offset(robot, 0.0), posture)


@wp.func
def spin(robot: RobotView, state: AttitudeState) -> float:
    """Spin: square of the base's angular speed [rad^2/s^2]."""
    return wp.length_sq(robot.ang_vel)
