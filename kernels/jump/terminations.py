"""Termination terms of jumps, as functions of robot, jump and parameters; times in policy steps of 1/60 s.

Except `landed_for`, each term ends an attempt that has failed or would damage the robot. The robot then gets no further
reward, and good jumps get more of the training time. World z is up. `state.goal` is (x, y of the landing, base height
at the apex).
"""

import warp as wp

from ..mdp.durations import whole_steps
from ..mdp.view import RobotView, angle_from_level, base_deceleration, yaw_of
from .phase import landing_error_estimate
from .state import FLIGHT, LANDED, STANCE, JumpState, commanded, goal_offset, waiting, wanted_squat


@wp.func
def landed_for(robot: RobotView, state: JumpState, steps: float) -> bool:
    """Terminate `steps` policy steps after touchdown: the jump is complete."""
    return state.phase == LANDED and state.phase_steps >= whole_steps(steps)


@wp.func
def wrong_height(robot: RobotView, state: JumpState, tolerance: float) -> bool:
    """Terminate at touchdown if the highest base height is more than `tolerance` [m] from the commanded one."""
    return state.touched_down == 1 and wp.abs(state.max_height - state.goal[2]) > tolerance


@wp.func
def missed_goal(robot: RobotView, state: JumpState, tolerance: float) -> bool:
    """Terminate at touchdown if the base is more than `tolerance` [m] from the goal, horizontally."""
    return state.touched_down == 1 and wp.length(goal_offset(robot, state)) > tolerance


@wp.func
def predicted_miss(robot: RobotView, state: JumpState, tolerance: float, steps: float, height: float) -> bool:
    """Terminate `steps` policy steps after takeoff if the ballistic landing is more than `tolerance` [m] off the goal.

    The ballistic landing is p_xy + t v_xy with t = (v_z + sqrt(v_z^2 + 2g (z - h))) / g, where the base falls through
    h, `height` [m] above the goal's ground.
    """
    if state.phase != FLIGHT or state.phase_steps != whole_steps(steps):
        return False
    return landing_error_estimate(robot, state, height) > tolerance


@wp.func
def turned_touchdown(robot: RobotView, state: JumpState, rotation: float, yaw: float) -> bool:
    """Terminate at touchdown if the base's orientation is too far from level with the jump's heading.

    `rotation` [rad] is the largest angle between the two orientations, `yaw` [rad] the largest error of the yaw.
    """
    turn = yaw_of(robot.quat) - state.heading
    yaw_error = wp.abs(wp.atan2(wp.sin(turn), wp.cos(turn)))
    return state.touched_down == 1 and (angle_from_level(robot.quat, state.heading) > rotation or yaw_error > yaw)


@wp.func
def second_takeoff(robot: RobotView, state: JumpState, speed: float) -> bool:
    """Terminate after touchdown if no paw is in contact and the base rises faster than `speed` [m/s]."""
    return state.phase == LANDED and robot.contacts == 0 and robot.lin_vel[2] > speed


@wp.func
def low_touchdown(robot: RobotView, state: JumpState, height: float) -> bool:
    """Terminate at touchdown if the base origin is less than `height` [m] above the ground."""
    return state.touched_down == 1 and robot.height < height


@wp.func
def moved_away(robot: RobotView, state: JumpState, distance: float) -> bool:
    """Terminate if the base is more than `distance` [m] from the start of the jump, horizontally, in any phase."""
    return wp.length(wp.vec2(robot.pos[0] - state.start[0], robot.pos[1] - state.start[1])) > distance


@wp.func
def left_stance(robot: RobotView, state: JumpState, distance: float) -> bool:
    """Terminate in stance if the base is more than `distance` [m] from the start of the jump, horizontally.

    A robot must jump to its goal, and not walk there.
    """
    return state.phase == STANCE and moved_away(robot, state, distance)


@wp.func
def walked(robot: RobotView, state: JumpState, margin: float, fraction: float) -> bool:
    """Terminate if the base moves farther than a limit from the start in stance, or touches down farther from the goal.

    Distances are horizontal. The limit is margin [m] + fraction · (distance from start to goal). Else a robot could
    walk, hop, and walk on.
    """
    limit = margin + fraction * wp.length(wp.vec2(state.goal[0] - state.start[0], state.goal[1] - state.start[1]))
    return left_stance(robot, state, limit) or missed_goal(robot, state, limit)


@wp.func
def slanted_takeoff(robot: RobotView, state: JumpState, speed: float) -> bool:
    """Terminate at takeoff if the base moves horizontally faster than `speed` [m/s]: a vertical jump would drift."""
    return state.took_off == 1 and wp.length(wp.vec2(robot.lin_vel[0], robot.lin_vel[1])) > speed


@wp.func
def hard_impact(robot: RobotView, state: JumpState, stance: float, flight: float) -> bool:
    """Terminate if the base's deceleration exceeds a limit [m/s^2]: `stance` in stance, `flight` in later phases.

    `base_deceleration` is minus the deceleration, <= 0.
    """
    limit = wp.where(state.phase == STANCE, stance, flight)
    return base_deceleration(robot) < -limit


@wp.func
def no_jump(robot: RobotView, state: JumpState, steps: float, idle_steps: float) -> bool:
    """Terminate if no takeoff follows a command within `steps` policy steps, or the robot idles instead of pushing off.

    A robot idles if its base rests for more than `idle_steps` policy steps.
    """
    late = state.steps - state.command_step > whole_steps(steps)
    return waiting(state) and (late or state.idle_steps > whole_steps(idle_steps))


@wp.func
def early_takeoff(robot: RobotView, state: JumpState) -> bool:
    """Terminate at a takeoff before the command; else a policy could ignore the command."""
    return state.took_off == 1 and state.steps < state.command_step


@wp.func
def shallow_squat(
    robot: RobotView, state: JumpState, tolerance: float, takeoff_height: float, acceleration: float, floor: float
) -> bool:
    """Terminate at takeoff if the base was never lower than `wanted_squat` plus `tolerance` [m] since the command."""
    limit = wanted_squat(robot, state, takeoff_height, acceleration, floor) + tolerance
    return state.took_off == 1 and state.squat > limit


@wp.func
def crouched(robot: RobotView, state: JumpState, height: float, start_steps: float, landing_steps: float) -> bool:
    """Terminate if the base is lower than `height` [m] although the robot has had time to stand up.

    The time is `start_steps` policy steps from the start of an episode, until the command, and `landing_steps` from
    touchdown.
    """
    if robot.height >= height:
        return False
    if state.phase == LANDED:
        return state.phase_steps > whole_steps(landing_steps)
    return state.phase == STANCE and not commanded(state) and state.steps > whole_steps(start_steps)
