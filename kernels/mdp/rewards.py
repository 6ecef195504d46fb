"""Reward terms that any task can use, as functions of the robot's state, the task's state and parameters.

Penalties return positive values: their weights in the tasks are negative. Vectors of 12 are motors 3 * leg + j: legs
FL, FR, BL, BR; j lateral (m % 3 = 0), outer, inner (the transversal ones). World z is up. Penalties of torque,
acceleration and changing actions give motions that a real robot's motors can follow.
"""

from typing import Any

import warp as wp

from .view import RobotView, tilt, vec12


@wp.func
def phi(x: float, s: float) -> float:
    """Return a Gaussian kernel of x, 1 at zero: phi_s(x) = exp(-x^2 / s^2) of the paper; s: width in x's unit."""
    return wp.exp(-x * x / (s * s))


@wp.func
def psi(x: float, s: float) -> float:
    """Return a Laplacian kernel of x, 1 at zero: psi_s(x) = exp(-|x| / s) of the paper; s: width in x's unit."""
    return wp.exp(-wp.abs(x) / s)


@wp.func
def root(square: float) -> float:
    """Return the square root, with a gradient of 0 at 0, in place of infinity: a size of 0 is a minimum."""
    return wp.sqrt(square)


@wp.func_grad(root)
def root_adjoint(square: float, adj_ret: float):
    """Add the gradient of `root` w.r.t. its argument to `wp.adjoint`."""
    if square > 0.0:
        wp.adjoint[square] += 0.5 * adj_ret / wp.sqrt(square)


@wp.func
def square_sum(v: vec12) -> float:
    """Return the sum of squares of a vector of 12 motor values."""
    return wp.dot(v, v)


@wp.func
def posture_offset(robot: RobotView, shift: float) -> float:
    """Return the rms offset [rad] of all motors from the default pose plus `shift` [rad] on transversal angles."""
    total = float(0.0)
    for m in range(12):
        offset = robot.angle[m] - robot.default_angle[m]
        if m % 3 != 0:
            offset = offset - shift
        total += offset * offset
    return root(total / 12.0)


@wp.func
def level(robot: RobotView, state: Any, width: float) -> float:
    """Reward for a level base: Gaussian kernel phi of the base's tilt [rad]; width [rad] of the kernel."""
    return phi(tilt(robot), width)


@wp.func
def horizontal_speed_sq(robot: RobotView, state: Any) -> float:
    """Penalty of horizontal motion: squared horizontal speed of the base [m^2/s^2]."""
    return robot.lin_vel[0] * robot.lin_vel[0] + robot.lin_vel[1] * robot.lin_vel[1]


@wp.func
def ground_force(robot: RobotView, state: Any, weight_force: float) -> float:
    """Penalty of large ground forces: sum over paws of squared force over squared weight; weight_force: weight [N]."""
    return wp.dot(robot.paw_force, robot.paw_force) / (weight_force * weight_force)


@wp.func
def action_clip(robot: RobotView, state: Any) -> float:
    """Penalty of actions that the command filter changes: sum of squared changes of motor targets [rad^2].

    Beyond a limit different actions have the same effect, so that no other term would keep the policy within limits.
    """
    return robot.clipped


@wp.func
def motor_torque_sq(robot: RobotView, state: Any) -> float:
    """Penalty of motor torque: sum over motors of squared torque [N^2 m^2]."""
    return square_sum(robot.torque)


@wp.func
def joint_acceleration(robot: RobotView, state: Any) -> float:
    """Penalty of motor acceleration: sum over motors of squared acceleration [rad^2/s^4]."""
    return square_sum(robot.joint_acc)


@wp.func
def action_rate(robot: RobotView, state: Any) -> float:
    """Penalty of changes of the action: sum of their squares since the previous policy step [1]."""
    return square_sum(robot.action - robot.prev_action)


@wp.func
def action_acceleration(robot: RobotView, state: Any) -> float:
    """Penalty of jerky actions: sum of squares of the action's second difference over policy steps [1]."""
    return square_sum(robot.action - 2.0 * robot.prev_action + robot.prev_prev_action)


@wp.func
def torque_sign_changes(robot: RobotView, state: Any) -> float:
    """Penalty of jerky motor torques: number of motors whose torque changed its sign in a policy step."""
    total = float(0.0)
    for m in range(12):
        total += wp.where(wp.sign(robot.torque[m]) != wp.sign(robot.prev_torque[m]), 1.0, 0.0)
    return total


@wp.func
def collision(robot: RobotView, state: Any) -> float:
    """Penalty of collisions: 1 if anything but a paw touched the ground or links touched each other, else 0."""
    return wp.where(robot.collisions != 0, 1.0, 0.0)
