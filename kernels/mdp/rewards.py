"""Reward terms that any task can use: pure functions of the robot, the task's state and named numbers.

phi(x, s) = exp(-x^2 / s^2), psi(x, s) = exp(-|x| / s) as in the paper's tables.
"""

from typing import Any

import warp as wp

from .view import RobotView, vec12


@wp.func
def phi(x: float, s: float) -> float:
    """Return the exponential kernel phi_s(x)."""
    return wp.exp(-x * x / (s * s))


@wp.func
def psi(x: float, s: float) -> float:
    """Return the Laplacian kernel psi_s(x)."""
    return wp.exp(-wp.abs(x) / s)


@wp.func
def square_sum(v: vec12) -> float:
    """Return the sum of squares."""
    return wp.dot(v, v)


@wp.func
def posture_offset(robot: RobotView, shift: float) -> float:
    """Return the rms offset [rad] of all motors from the default pose, the transversal ones shifted by `shift`."""
    total = float(0.0)
    for m in range(12):
        off = robot.angle[m] - robot.default_angle[m]
        if m % 3 != 0:
            off = off - shift
        total += off * off
    return wp.sqrt(total / 12.0)


@wp.func
def ground_force(robot: RobotView, state: Any, weight_force: float) -> float:
    """Ground force L2: sum of squared paw forces over that of the robot's weight [N]."""
    return wp.dot(robot.paw_force, robot.paw_force) / (weight_force * weight_force)


@wp.func
def action_clip(robot: RobotView, state: Any) -> float:
    """Action clip: squared distance that the command filter moved the targets [rad^2]."""
    return robot.clipped


@wp.func
def motor_torque_sq(robot: RobotView, state: Any) -> float:
    """Motor torque: sum of squares [N^2 m^2]."""
    return square_sum(robot.torque)


@wp.func
def joint_acceleration(robot: RobotView, state: Any) -> float:
    """Joint acceleration: sum of squares [rad^2/s^4]."""
    return square_sum(robot.joint_acc)


@wp.func
def action_rate(robot: RobotView, state: Any) -> float:
    """Action rate: sum of squared changes of the action."""
    return square_sum(robot.action - robot.prev_action)


@wp.func
def action_acceleration(robot: RobotView, state: Any) -> float:
    """Action acceleration: sum of squared second differences of the action."""
    return square_sum(robot.action - 2.0 * robot.prev_action + robot.prev_prev_action)


@wp.func
def collision(robot: RobotView, state: Any) -> float:
    """Collision: 1 if anything but a paw touched the ground, or links touched each other."""
    return wp.where(robot.collisions != 0, 1.0, 0.0)
