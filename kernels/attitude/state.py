"""State of the attitude task (`AttitudeState`), and its update in a policy step of 1/60 s.

Quaternions are xyzw, body to world; world z is up.
"""

import warp as wp

from ..mdp.view import RobotView

POLICY_RATE = wp.constant(60.0)  # policy steps in a second


@wp.struct
class AttitudeState:
    """State of the attitude task in one world: goal orientation, error, collisions, statistics of episodes.

    Fields from `episodes` on accumulate until the host reads them.
    """

    goal: wp.quat  # xyzw, body to world: commanded orientation
    steps: int  # policy steps since the episode began
    episode_steps: int  # policy steps that it lasts, 0: no end
    error: float  # [rad] angle of the rotation to the goal
    old_error: float  # [rad] `error` of the previous policy step
    inside: int  # consecutive policy steps with `error` within tolerance, 0 outside
    collisions: int  # policy steps in which links touched each other or anything but a paw touched the ground
    episodes: float  # number of episodes that lasted `episode_steps`
    sum_error: float  # [rad] sum of `error` at their ends
    settled: float  # number of them that ended within tolerance
    sum_settling: float  # [s] sum over `settled` of the time from the start until the error stays within tolerance
    sum_collisions: float  # [s] sum of the time in collision


@wp.func
def rotation_between(quat: wp.quat, goal: wp.quat) -> wp.quat:
    """Return the rotation (xyzw, body axes, w >= 0) from orientation `quat` to `goal` (both xyzw, body to world)."""
    turn = wp.quat_inverse(quat) * goal
    return wp.where(turn[3] < 0.0, -turn, turn)


@wp.func
def angle_between(quat: wp.quat, goal: wp.quat) -> float:
    """Return the angle [rad], 0 to pi, between two orientations (xyzw, body to world)."""
    turn = rotation_between(quat, goal)
    return 2.0 * wp.atan2(wp.length(wp.vec3(turn[0], turn[1], turn[2])), turn[3])


@wp.func
def with_goal(state: AttitudeState, quat: wp.quat, goal: wp.quat) -> AttitudeState:
    """Return the task state with a new goal; quat, goal: present and goal orientation (xyzw, body to world).

    `old_error` is also set to the new error, so that a change of the goal does not count as a motion toward it.
    """
    new = state
    new.goal = goal
    new.error = angle_between(quat, goal)
    new.old_error = new.error
    new.inside = 0
    return new


@wp.func
def advance_attitude(robot: RobotView, state: AttitudeState, tolerance: float) -> AttitudeState:
    """Return the state of the attitude task (errors, counters) updated by one policy step.

    tolerance [rad]: largest error that counts as at the goal.
    """
    t = state
    t.steps = state.steps + 1
    t.old_error = state.error
    t.error = angle_between(robot.quat, state.goal)
    t.inside = wp.where(t.error <= tolerance, state.inside + 1, 0)
    if robot.collisions != 0:
        t.collisions = state.collisions + 1
    return t


@wp.func
def carried_over(old: AttitudeState) -> AttitudeState:
    """Return a state for a new episode that keeps only the accumulated statistics of `old`, the previous state.

    The statistics include the previous episode if it was complete. Its settling time is the time of the first step
    after which the error stayed within tolerance. The reset sets the other fields.
    """
    new = AttitudeState()
    new.episodes = old.episodes
    new.sum_error = old.sum_error
    new.settled = old.settled
    new.sum_settling = old.sum_settling
    new.sum_collisions = old.sum_collisions
    if old.steps > 0 and old.episode_steps > 0 and old.steps >= old.episode_steps:
        new.episodes = old.episodes + 1.0
        if wp.isfinite(old.error):
            new.sum_error = old.sum_error + old.error
        new.sum_collisions = old.sum_collisions + float(old.collisions) / POLICY_RATE
        if old.inside > 0:
            new.settled = old.settled + 1.0
            new.sum_settling = old.sum_settling + float(old.steps - old.inside + 1) / POLICY_RATE
    return new


@wp.func
def attitude_error(robot: RobotView, state: AttitudeState) -> float:
    """Return the curriculum's error: angle [rad] from the base's orientation to the goal; `robot` is unused."""
    return state.error


@wp.func
def every_episode(state: AttitudeState) -> bool:
    """Return True, since every episode counts for the curriculum."""
    return True
