"""State of the attitude task (`AttitudeState`), and its update in a policy step."""

import warp as wp

from ..mdp.view import RobotView

POLICY_RATE = wp.constant(60.0)  # policy steps in a second


@wp.struct
class AttitudeState:
    """Task state of one world; statistics accumulate over episodes until the host reads them."""

    goal: wp.quat  # xyzw, body to world: wanted orientation
    steps: int  # policy steps since the episode began
    episode_steps: int  # policy steps that it lasts, 0: no end
    error: float  # [rad] angle of the rotation to the goal
    old_error: float  # [rad] one policy step before
    inside: int  # policy steps in a row with an error within tolerance, up to now
    collisions: int  # policy steps in which anything but paws touched something, or links touched each other
    jump_start: wp.vec3  # [m] where the jump began whose flight this is, if it is one
    jump_goal: wp.vec3  # [m] where it is to land, base x, y; and its wanted height at the apex
    goal_ground: float  # [m] height of the ground there
    max_height: float  # [m] of the base since takeoff
    episodes: float  # that were followed to an end, counted
    sum_error: float  # [rad] of their errors at the end
    settled: float  # of these, how many ended within tolerance
    sum_settling: float  # [s] of the times in which these came there to stay
    sum_collisions: float  # [s] in collision


@wp.func
def rotation_between(quat: wp.quat, goal: wp.quat) -> wp.quat:
    """Return the rotation from an orientation to a goal (xyzw, body to world), body axes, w >= 0."""
    turn = wp.quat_inverse(quat) * goal
    return wp.where(turn[3] < 0.0, -turn, turn)


@wp.func
def angle_between(quat: wp.quat, goal: wp.quat) -> float:
    """Return the angle [rad] of the rotation from an orientation to a goal (xyzw), 0 to pi."""
    turn = rotation_between(quat, goal)
    return 2.0 * wp.atan2(wp.length(wp.vec3(turn[0], turn[1], turn[2])), turn[3])


@wp.func
def with_goal(state: AttitudeState, quat: wp.quat, goal: wp.quat) -> AttitudeState:
    """Return the state with a new goal; quat, goal: present and wanted orientation (xyzw), body to world."""
    new = state
    new.goal = goal
    new.error = angle_between(quat, goal)
    new.old_error = new.error
    new.inside = 0
    return new


@wp.func
def advance_attitude(robot: RobotView, state: AttitudeState, tolerance: float) -> AttitudeState:
    """Return the state one policy step later; tolerance [rad]: error up to which the robot is at its goal."""
    t = state
    t.steps = state.steps + 1
    t.old_error = state.error
    t.error = angle_between(robot.quat, state.goal)
    t.inside = wp.where(t.error <= tolerance, state.inside + 1, 0)
    t.max_height = wp.max(state.max_height, robot.pos[2])
    if robot.collisions != 0:
        t.collisions = state.collisions + 1
    return t


@wp.func
def carried_over(old: AttitudeState) -> AttitudeState:
    """Return the initial state of the next episode, statistics kept; an old one that came to its end is counted."""
    new = AttitudeState()
    new.episodes = old.episodes
    new.sum_error = old.sum_error
    new.settled = old.settled
    new.sum_settling = old.sum_settling
    new.sum_collisions = old.sum_collisions
    if old.steps > 0 and old.episode_steps > 0 and old.steps >= old.episode_steps:
        new.episodes = old.episodes + 1.0
        new.sum_error = old.sum_error + old.error
        new.sum_collisions = old.sum_collisions + float(old.collisions) / POLICY_RATE
        if old.inside > 0:
            new.settled = old.settled + 1.0
            new.sum_settling = old.sum_settling + float(old.steps - old.inside + 1) / POLICY_RATE
    return new


@wp.func
def attitude_error(robot: RobotView, state: AttitudeState) -> float:
    """Angle of the rotation to the goal [rad]."""
    return state.error


@wp.func
def every_episode(state: AttitudeState) -> bool:
    """Return True: the curriculum counts every episode."""
    return True
