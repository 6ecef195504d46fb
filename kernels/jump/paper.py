"""Reward and termination terms of jumps as in the paper (Table IV), where this project's own tasks use other ones.

phi, psi: Gaussian and Laplacian kernels of `mdp.rewards`; std_*, scale_*: their widths, in the unit of their argument.
The deceleration along the base's present velocity is the paper's; the stock terms use its velocity before the step,
since plastic contact stops the base within a step. Terms return rewards; a task's weight gives their size. A ballistic
apex or landing is where the base would go without further forces: it rewards a good takeoff at once.
"""

import warp as wp

from ..mdp.durations import whole_steps
from ..mdp.rewards import phi, posture_offset, psi
from ..mdp.view import RobotView, angle_from_level
from .phase import estimated_apex, landing_error_estimate
from .rewards import just_landed
from .state import FLIGHT, LANDED, STANCE, JumpState, goal_offset


@wp.func
def height_reward(error: float, std: float, scale: float) -> float:
    """Return the reward for a height error [m]: Gaussian of width `std` plus 3 times Laplacian of width `scale` [m]."""
    return phi(error, std) + 3.0 * psi(error, scale)


@wp.func
def jump_height(robot: RobotView, state: JumpState, std: float, scale: float) -> float:
    """Reward for a jump whose highest base height is close to the commanded one, given once, at the apex.

    The reward is phi_std + 3 psi_scale of their difference [m].
    """
    if state.at_apex == 0:
        return 0.0
    return height_reward(state.max_height - state.goal[2], std, scale)


@wp.func
def estimated_jump_height(robot: RobotView, state: JumpState, std: float, scale: float) -> float:
    """Reward for a ballistic apex of the base close to the commanded height, in flight before the apex.

    The reward is phi_std + 3 psi_scale of their difference [m]. The ballistic apex is z + v_z^2 / 2g, or z if the base
    falls.
    """
    if state.phase != FLIGHT or state.apex_passed != 0:
        return 0.0
    apex = estimated_apex(robot.pos, robot.lin_vel, robot.gravity_magnitude)
    return height_reward(apex - state.goal[2], std, scale)


@wp.func
def tracking(robot: RobotView, state: JumpState, std: float) -> float:
    """Reward for a base close to the goal, in every phase: Gaussian phi_std of the horizontal distance [m]."""
    return phi(wp.length(goal_offset(robot, state)), std)


@wp.func
def estimated_tracking(robot: RobotView, state: JumpState, std: float, std_wide: float, height: float) -> float:
    """Reward in flight for a predicted landing of the base close to the goal.

    The reward is phi_std + 0.1 phi_wide of the distance [m]. The predicted landing is p_xy + t v_xy with t = (v_z +
    sqrt(v_z^2 + 2g (z - h))) / g, where the base falls through h, `height` [m] above the goal's ground.
    """
    if state.phase != FLIGHT:
        return 0.0
    error = landing_error_estimate(robot, state, height)
    return phi(error, std) + 0.1 * phi(error, std_wide)


@wp.func
def orientation_error(robot: RobotView, state: JumpState, std: float) -> float:
    """Reward for a level base in the jump's heading: Gaussian phi_std of the squared rotation error [rad^2]."""
    error = angle_from_level(robot.quat, state.heading)
    return phi(error * error, std)


@wp.func
def flight_orientation_error(robot: RobotView, state: JumpState, std: float) -> float:
    """Reward for a level base with the jump's heading, in flight while the base moves toward the goal.

    The reward is phi_std of the squared rotation error [rad^2].
    """
    if state.phase != FLIGHT or wp.dot(robot.lin_vel, goal_offset(robot, state)) <= 0.0:
        return 0.0
    return orientation_error(robot, state, std)


@wp.func
def landed_posture(robot: RobotView, state: JumpState, std: float, shift: float) -> float:
    """Reward after touchdown for motor angles near the default pose plus `shift` [rad] on transversal angles.

    The reward is phi_std of the rms motor offset [rad] from that pose.
    """
    if state.phase != LANDED:
        return 0.0
    return phi(posture_offset(robot, shift), std)


@wp.func
def impact_acceleration(robot: RobotView) -> float:
    """Return minus the base's deceleration along its velocity [m/s^2], mean of the policy step; 0 if it speeds up.

    The result is never positive: -49 means that the base is slowed by 5 g.
    """
    return wp.min(wp.dot(robot.lin_acc, wp.normalize(robot.lin_vel)), 0.0)


@wp.func
def soft_impact(robot: RobotView, state: JumpState, limit: float) -> float:
    """Reward for a soft impact, for 0.3 s from touchdown: max(0, 1 - deceleration / limit [m/s^2]).

    It is 1 without deceleration, and 0 from the limit on. The plus sign below is due to the sign of
    `impact_acceleration`, which is minus the deceleration.
    """
    if not just_landed(state):
        return 0.0
    return wp.max(0.0, 1.0 + impact_acceleration(robot) / limit)


@wp.func
def hard_impact(robot: RobotView, state: JumpState, stance: float, flight: float) -> bool:
    """Terminate if the base's deceleration exceeds a limit [m/s^2]: `stance` in stance, `flight` in later phases.

    `impact_acceleration` is minus the deceleration.
    """
    return impact_acceleration(robot) < -wp.where(state.phase == STANCE, stance, flight)


@wp.func
def predicted_height_miss(robot: RobotView, state: JumpState, tolerance: float, steps: float) -> bool:
    """Terminate `steps` policy steps after takeoff if the ballistic apex is > `tolerance` [m] off the commanded one."""
    if state.phase != FLIGHT or state.phase_steps != whole_steps(steps) or state.apex_passed != 0:
        return False
    apex = estimated_apex(robot.pos, robot.lin_vel, robot.gravity_magnitude)
    return wp.abs(apex - state.goal[2]) > tolerance
