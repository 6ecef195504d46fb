"""Why an episode of jumps ends: pure functions of robot, jump and named numbers; times in policy steps."""

import warp as wp

from ..mdp.view import RobotView, angle_from_level, base_deceleration, yaw_of
from .phase import landing_error_estimate
from .state import FLIGHT, LANDED, STANCE, JumpState, goal_offset, waiting


@wp.func
def success(robot: RobotView, state: JumpState, steps: float) -> bool:
    """So many policy steps after touchdown: the jump is over."""
    return state.phase == LANDED and state.phase_steps >= int(steps)


@wp.func
def wrong_height(robot: RobotView, state: JumpState, tolerance: float) -> bool:
    """At touchdown the jump missed its height by more than a tolerance [m]."""
    return state.touched_down == 1 and wp.abs(state.max_height - state.goal[2]) > tolerance


@wp.func
def missed_goal(robot: RobotView, state: JumpState, tolerance: float) -> bool:
    """Base more than a tolerance [m] beside the goal at touchdown."""
    return state.touched_down == 1 and wp.length(goal_offset(robot, state)) > tolerance


@wp.func
def predicted_miss(robot: RobotView, state: JumpState, tolerance: float, steps: float, height: float) -> bool:
    """After so many policy steps in flight the ballistic landing at a height [m] misses the goal by more [m]."""
    if state.phase != FLIGHT or state.phase_steps != int(steps):
        return False
    return landing_error_estimate(robot, state, height) > tolerance


@wp.func
def turned_touchdown(robot: RobotView, state: JumpState, rotation: float, yaw: float) -> bool:
    """At touchdown rotated by more than `rotation` [rad] from level and heading, or by `yaw` [rad] about z."""
    turn = yaw_of(robot.quat) - state.heading
    off = wp.abs(wp.atan2(wp.sin(turn), wp.cos(turn)))
    return state.touched_down == 1 and (angle_from_level(robot.quat, state.heading) > rotation or off > yaw)


@wp.func
def second_takeoff(robot: RobotView, state: JumpState, speed: float) -> bool:
    """Off the ground again after touchdown, with no paw down, and upward faster than a speed [m/s]."""
    return state.phase == LANDED and robot.contacts == 0 and robot.lin_vel[2] > speed


@wp.func
def low_touchdown(robot: RobotView, state: JumpState, height: float) -> bool:
    """Base less than a height [m] above the ground at touchdown."""
    return state.touched_down == 1 and robot.height < height


@wp.func
def moved_away(robot: RobotView, state: JumpState, distance: float) -> bool:
    """Base more than a distance [m] from where it started, at any time."""
    return wp.length(wp.vec2(robot.pos[0] - state.start[0], robot.pos[1] - state.start[1])) > distance


@wp.func
def left_stance(robot: RobotView, state: JumpState, distance: float) -> bool:
    """Base more than a distance [m] from where the jump began, still standing."""
    return state.phase == STANCE and moved_away(robot, state, distance)


@wp.func
def slanted_takeoff(robot: RobotView, state: JumpState, speed: float) -> bool:
    """Horizontal speed above a limit [m/s] at takeoff."""
    return state.took_off == 1 and wp.length(wp.vec2(robot.lin_vel[0], robot.lin_vel[1])) > speed


@wp.func
def hard_impact(robot: RobotView, state: JumpState, stance: float, flight: float) -> bool:
    """Deceleration above `stance` [m/s^2] in stance, above `flight` in flight and after touchdown."""
    limit = wp.where(state.phase == STANCE, stance, flight)
    return base_deceleration(robot) < -limit


@wp.func
def no_jump(robot: RobotView, state: JumpState, steps: float, idle_steps: float) -> bool:
    """A commanded jump did not begin within `steps` policy steps, or the base rested for `idle_steps`."""
    return waiting(state) and (state.steps - state.command_step > int(steps) or state.idle_steps > int(idle_steps))


@wp.func
def early_takeoff(robot: RobotView, state: JumpState) -> bool:
    """Jumped before the jump was commanded."""
    return state.took_off == 1 and state.steps < state.command_step
