"""Reward terms of turning in free flight."""

import warp as wp

from ..mdp.rewards import phi, posture_offset
from ..mdp.view import RobotView
from .state import POLICY_RATE, AttitudeState


@wp.func
def approach(robot: RobotView, state: AttitudeState) -> float:
    """Approach: decrease of the angle to the goal per second [rad/s]; negative while the angle grows."""
    return (state.old_error - state.error) * POLICY_RATE


@wp.func
def attitude(robot: RobotView, state: AttitudeState, std: float) -> float:
    """Attitude: phi of the angle to the goal, 1 at the goal; std [rad]: width of phi."""
    return phi(state.error, std)


@wp.func
def hold(robot: RobotView, state: AttitudeState, std: float, std_ang_vel: float) -> float:
    """Hold: phi(angle to the goal; std [rad]) times phi(angular speed; std_ang_vel [rad/s]), 1 at rest at the goal."""
    return phi(state.error, std) * phi(wp.length(robot.ang_vel), std_ang_vel)


@wp.func
def landing_posture(robot: RobotView, state: AttitudeState, std: float, std_posture: float) -> float:
    """Landing posture: phi(angle to the goal; std [rad]) times phi(rms offset from default; std_posture [rad])."""
    return phi(state.error, std) * phi(posture_offset(robot, 0.0), std_posture)


@wp.func
def spin(robot: RobotView, state: AttitudeState) -> float:
    """Spin: square of the base's angular speed [rad^2/s^2]."""
    return wp.length_sq(robot.ang_vel)
