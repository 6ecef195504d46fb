"""Reward terms of turning in free flight. The sign is in the weights: penalties return positive values.

`state.error` is the angle [rad] of the rotation from the base's orientation to the goal.
"""

import warp as wp

from ..mdp.rewards import phi, posture_offset
from ..mdp.view import RobotView
from .state import POLICY_RATE, AttitudeState


@wp.func
def approach(robot: RobotView, state: AttitudeState) -> float:
    """Reward for turning toward the goal orientation: decrease of the angle to it per second [rad/s].

    The sum over an episode is the decrease of the angle, so turning back and forth pays nothing.
    """
    return (state.old_error - state.error) * POLICY_RATE


@wp.func
def attitude(robot: RobotView, state: AttitudeState, std: float) -> float:
    """Reward for an orientation close to the goal: Gaussian phi of the angle to it, 1 at the goal; std [rad]: width."""
    return phi(state.error, std)


@wp.func
def hold(robot: RobotView, state: AttitudeState, std: float, std_ang_vel: float) -> float:
    """Reward for rest at the goal orientation: product of Gaussians phi of the angle to it and of the angular speed.

    std [rad], std_ang_vel [rad/s]: their widths. Because of the product, the robot must rest only near the goal. Far
    from the goal, it must rotate.
    """
    return phi(state.error, std) * phi(wp.length(robot.ang_vel), std_ang_vel)


@wp.func
def landing_posture(robot: RobotView, state: AttitudeState, std: float, std_posture: float) -> float:
    """Reward for the default pose at the goal orientation: product of Gaussians phi of angle and motor offset.

    Legs in the default pose can take a landing; away from the goal they are free to turn the robot.
    std [rad]: width for the angle to the goal orientation; std_posture [rad]: for the rms offset of all motors.
    """
    return phi(state.error, std) * phi(posture_offset(robot, 0.0), std_posture)


@wp.func
def spin(robot: RobotView, state: AttitudeState) -> float:
    """Penalty of rotation of the base: its squared angular speed [rad^2/s^2]."""
    return wp.length_sq(robot.ang_vel)
