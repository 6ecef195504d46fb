"""Why an episode ends. Each rule is a pure function of robot, episode and parameters p; times in policy steps."""

import warp as wp

from .phase import landing_error_estimate, tilt
from .rewards import braking
from .task import (
    FLIGHT,
    LANDED,
    STANCE,
    JumpTask,
    RobotView,
    goal_offset,
    rotation_from,
    speed_limit_broken,
    waiting,
    yaw_of,
)


@wp.func
def success(view: RobotView, task: JumpTask, p: wp.vec4) -> bool:
    """p0 policy steps after touchdown: the jump is over."""
    return task.phase == LANDED and task.phase_steps >= int(p[0])


@wp.func
def too_long(view: RobotView, task: JumpTask, p: wp.vec4) -> bool:
    """Episode of p0 policy steps."""
    return task.steps >= int(p[0])


@wp.func
def came_apart(view: RobotView, task: JumpTask, p: wp.vec4) -> bool:
    """State non-finite or absurdly fast."""
    return speed_limit_broken(view)


@wp.func
def wrong_height(view: RobotView, task: JumpTask, p: wp.vec4) -> bool:
    """At touchdown the jump missed its height by more than p0 [m]."""
    return task.touched_down == 1 and wp.abs(task.max_height - task.goal[2]) > p[0]


@wp.func
def missed_goal(view: RobotView, task: JumpTask, p: wp.vec4) -> bool:
    """Base more than p0 [m] beside the goal at touchdown."""
    return task.touched_down == 1 and wp.length(goal_offset(view, task)) > p[0]


@wp.func
def predicted_miss(view: RobotView, task: JumpTask, p: wp.vec4) -> bool:
    """p1 policy steps after takeoff the projectile falls through height p2 [m] more than p0 [m] beside the goal."""
    if task.phase != FLIGHT or task.phase_steps != int(p[1]):
        return False
    return landing_error_estimate(view, task, p[2]) > p[0]


@wp.func
def turned_touchdown(view: RobotView, task: JumpTask, p: wp.vec4) -> bool:
    """At touchdown rotated by more than p0 [rad] from level and heading, or by p1 in yaw alone."""
    yaw = yaw_of(view.quat) - task.heading
    off = wp.abs(wp.atan2(wp.sin(yaw), wp.cos(yaw)))
    return task.touched_down == 1 and (rotation_from(view.quat, task.heading) > p[0] or off > p[1])


@wp.func
def low_touchdown(view: RobotView, task: JumpTask, p: wp.vec4) -> bool:
    """Base less than p0 [m] above the ground at touchdown."""
    return task.touched_down == 1 and view.height < p[0]


@wp.func
def low_base(view: RobotView, task: JumpTask, p: wp.vec4) -> bool:
    """Base less than p0 [m] above the ground."""
    return view.height < p[0]


@wp.func
def moved_away(view: RobotView, task: JumpTask, p: wp.vec4) -> bool:
    """Base more than p0 [m] from where it started, at any time."""
    return wp.length(wp.vec2(view.pos[0] - task.start[0], view.pos[1] - task.start[1])) > p[0]


@wp.func
def left_stance(view: RobotView, task: JumpTask, p: wp.vec4) -> bool:
    """Base more than p0 [m] from where the jump began, still standing."""
    return task.phase == STANCE and moved_away(view, task, p)


@wp.func
def slanted_takeoff(view: RobotView, task: JumpTask, p: wp.vec4) -> bool:
    """Horizontal speed above p0 [m/s] at takeoff."""
    return task.took_off == 1 and wp.length(wp.vec2(view.lin_vel[0], view.lin_vel[1])) > p[0]


@wp.func
def tilted(view: RobotView, task: JumpTask, p: wp.vec4) -> bool:
    """Body z more than p0 [rad] from vertical."""
    return tilt(view) > p[0]


@wp.func
def hard_impact(view: RobotView, task: JumpTask, p: wp.vec4) -> bool:
    """Deceleration above p0 [m/s^2] in stance, p1 in flight and after touchdown."""
    limit = wp.where(task.phase == STANCE, p[0], p[1])
    return braking(view) < -limit


@wp.func
def no_jump(view: RobotView, task: JumpTask, p: wp.vec4) -> bool:
    """A commanded jump did not begin within p0 policy steps, or the base rested for p1."""
    return waiting(task) and (task.steps - task.command_step > int(p[0]) or task.idle_steps > int(p[1]))


@wp.func
def collided(view: RobotView, task: JumpTask, p: wp.vec4) -> bool:
    """Anything but a paw touched the ground, or links touched each other."""
    return view.collisions != 0


@wp.func
def early_takeoff(view: RobotView, task: JumpTask, p: wp.vec4) -> bool:
    """Jumped before the jump was commanded."""
    return task.took_off == 1 and task.steps < task.command_step
