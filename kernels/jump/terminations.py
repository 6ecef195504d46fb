"""Why an episode of jumps ends: pure functions of robot, jump and named numbers; times in policy steps."""

import warp as wp

from ..mdp.view import RobotView, braking, rotation_from, yaw_of
from .phase import landing_error_estimate
from .state import FLIGHT, LANDED, STANCE, JumpState, goal_offset, waiting


@wp.func
def success(robot: RobotView, task: JumpState, steps: float) -> bool:
    """So many policy steps after touchdown: the jump is over."""
    return task.phase == LANDED and task.phase_steps >= int(steps)


@wp.func
def wrong_height(robot: RobotView, task: JumpState, tolerance: float) -> bool:
    """At touchdown the jump missed its height by more than a tolerance [m]."""
    return task.touched_down == 1 and wp.abs(task.max_height - task.goal[2]) > tolerance


@wp.func
def missed_goal(robot: RobotView, task: JumpState, tolerance: float) -> bool:
    """Base more than a tolerance [m] beside the goal at touchdown."""
    return task.touched_down == 1 and wp.length(goal_offset(robot, task)) > tolerance


@wp.func
def predicted_miss(robot: RobotView, task: JumpState, tolerance: float, steps: float, height: float) -> bool:
    """After so many policy steps in flight the ballistic landing at a height [m] misses the goal by more [m]."""
    if task.phase != FLIGHT or task.phase_steps != int(steps):
        return False
    return landing_error_estimate(robot, task, height) > tolerance


@wp.func
def turned_touchdown(robot: RobotView, task: JumpState, rotation: float, yaw: float) -> bool:
    """At touchdown rotated by more than `rotation` [rad] from level and heading, or by `yaw` [rad] about z."""
    turn = yaw_of(robot.quat) - task.heading
    off = wp.abs(wp.atan2(wp.sin(turn), wp.cos(turn)))
    return task.touched_down == 1 and (rotation_from(robot.quat, task.heading) > rotation or off > yaw)


@wp.func
def second_takeoff(robot: RobotView, task: JumpState, speed: float) -> bool:
    """Off the ground again after touchdown, with no paw down, and upward faster than a speed [m/s]."""
    return task.phase == LANDED and robot.contacts == 0 and robot.lin_vel[2] > speed


@wp.func
def low_touchdown(robot: RobotView, task: JumpState, height: float) -> bool:
    """Base less than a height [m] above the ground at touchdown."""
    return task.touched_down == 1 and robot.height < height


@wp.func
def moved_away(robot: RobotView, task: JumpState, distance: float) -> bool:
    """Base more than a distance [m] from where it started, at any time."""
    return wp.length(wp.vec2(robot.pos[0] - task.start[0], robot.pos[1] - task.start[1])) > distance


@wp.func
def left_stance(robot: RobotView, task: JumpState, distance: float) -> bool:
    """Base more than a distance [m] from where the jump began, still standing."""
    return task.phase == STANCE and moved_away(robot, task, distance)


@wp.func
def slanted_takeoff(robot: RobotView, task: JumpState, speed: float) -> bool:
    """Horizontal speed above a limit [m/s] at takeoff."""
    return task.took_off == 1 and wp.length(wp.vec2(robot.lin_vel[0], robot.lin_vel[1])) > speed


@wp.func
def hard_impact(robot: RobotView, task: JumpState, stance: float, flight: float) -> bool:
    """Deceleration above `stance` [m/s^2] in stance, above `flight` in flight and after touchdown."""
    limit = wp.where(task.phase == STANCE, stance, flight)
    return braking(robot) < -limit


@wp.func
def no_jump(robot: RobotView, task: JumpState, steps: float, idle_steps: float) -> bool:
    """A commanded jump did not begin within `steps` policy steps, or the base rested for `idle_steps`."""
    return waiting(task) and (task.steps - task.command_step > int(steps) or task.idle_steps > int(idle_steps))


@wp.func
def early_takeoff(robot: RobotView, task: JumpState) -> bool:
    """Jumped before the jump was commanded."""
    return task.took_off == 1 and task.steps < task.command_step
