"""Terminations of jumps: pure functions of robot, jump and named numbers; times in policy steps of 1/60 s."""

import warp as wp

from ..mdp.view import RobotView, angle_from_level, base_deceleration, yaw_of
from .phase import landing_error_estimate
from .state import FLIGHT, LANDED, STANCE, JumpState, goal_offset, waiting


@wp.func
def landed_for(robot: RobotView, state: JumpState, steps: float) -> bool:
    """Landed for `steps` policy steps: the jump is over."""
    return state.phase == LANDED and state.phase_steps >= int(steps)


@wp.func
def wrong_height(robot: RobotView, state: JumpState, tolerance: float) -> bool:
    """Highest base height more than `tolerance` [m] from the commanded one, at touchdown."""
    return state.touched_down == 1 and wp.abs(state.max_height - state.goal[2]) > tolerance


@wp.func
def missed_goal(robot: RobotView, state: JumpState, tolerance: float) -> bool:
    """Base more than `tolerance` [m] of horizontal distance from the goal, at touchdown."""
    return state.touched_down == 1 and wp.length(goal_offset(robot, state)) > tolerance


@wp.func
def predicted_miss(robot: RobotView, state: JumpState, tolerance: float, steps: float, height: float) -> bool:
    """Ballistic landing more than `tolerance` [m] from the goal, predicted once, `steps` policy steps after takeoff.

    height [m]: of the base above the goal's ground at the landing.
    """
    if state.phase != FLIGHT or state.phase_steps != int(steps):
        return False
    return landing_error_estimate(robot, state, height) > tolerance


@wp.func
def turned_touchdown(robot: RobotView, state: JumpState, rotation: float, yaw: float) -> bool:
    """At touchdown, rotation from level at the heading above `rotation` [rad], or yaw error above `yaw` [rad]."""
    turn = yaw_of(robot.quat) - state.heading
    yaw_error = wp.abs(wp.atan2(wp.sin(turn), wp.cos(turn)))
    return state.touched_down == 1 and (angle_from_level(robot.quat, state.heading) > rotation or yaw_error > yaw)


@wp.func
def second_takeoff(robot: RobotView, state: JumpState, speed: float) -> bool:
    """After touchdown, no paw in contact and upward speed above `speed` [m/s]."""
    return state.phase == LANDED and robot.contacts == 0 and robot.lin_vel[2] > speed


@wp.func
def low_touchdown(robot: RobotView, state: JumpState, height: float) -> bool:
    """Base origin less than `height` [m] above the ground, at touchdown."""
    return state.touched_down == 1 and robot.height < height


@wp.func
def moved_away(robot: RobotView, state: JumpState, distance: float) -> bool:
    """Base more than `distance` [m] of horizontal distance from the start of the jump, in any phase."""
    return wp.length(wp.vec2(robot.pos[0] - state.start[0], robot.pos[1] - state.start[1])) > distance


@wp.func
def left_stance(robot: RobotView, state: JumpState, distance: float) -> bool:
    """Base more than `distance` [m] of horizontal distance from the start of the jump, in stance."""
    return state.phase == STANCE and moved_away(robot, state, distance)


@wp.func
def slanted_takeoff(robot: RobotView, state: JumpState, speed: float) -> bool:
    """Horizontal speed of the base above `speed` [m/s], at takeoff."""
    return state.took_off == 1 and wp.length(wp.vec2(robot.lin_vel[0], robot.lin_vel[1])) > speed


@wp.func
def hard_impact(robot: RobotView, state: JumpState, stance: float, flight: float) -> bool:
    """Deceleration of the base above a limit [m/s^2]: `stance` in stance, `flight` in flight and after touchdown."""
    limit = wp.where(state.phase == STANCE, stance, flight)
    return base_deceleration(robot) < -limit


@wp.func
def no_jump(robot: RobotView, state: JumpState, steps: float, idle_steps: float) -> bool:
    """No takeoff within `steps` policy steps of the command, or base at rest for `idle_steps` of them."""
    return waiting(state) and (state.steps - state.command_step > int(steps) or state.idle_steps > int(idle_steps))


@wp.func
def early_takeoff(robot: RobotView, state: JumpState) -> bool:
    """Takeoff before the command."""
    return state.took_off == 1 and state.steps < state.command_step
