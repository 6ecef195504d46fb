"""State of velocity tracking (`VelocityState`), its update in a policy step of 1/60 s, and its errors.

Body axes are x ahead, y left, z up. A yaw rate counts 0.3 m times itself beside a speed: about the speed [m/s] of a
point 0.3 m from the base's centre.
"""

import warp as wp

from ..mdp.durations import whole_steps
from ..mdp.view import RobotView

POLICY_RATE = wp.constant(60.0)  # policy steps in a second
MAX_COUNTED_ERROR = wp.constant(40.0)  # [m/s], [rad/s] larger errors are those of a diverged world and do not count
vec4l = wp.types.vector(length=4, dtype=wp.int64)


@wp.struct
class VelocityState:
    """State of velocity tracking in a world: command, gait, tracking errors, curriculum levels and statistics.

    Errors count only in settled policy steps: right after a command the robot still has to accelerate.
    Fields from `sum_xy` on accumulate until the host reads them.
    """

    command: wp.vec3  # [m/s], [m/s], [rad/s] commanded velocity ahead, to the left and about z, body axes
    standing: int  # 1: commanded to stand
    steps: int  # policy steps since the episode began
    episode_steps: int  # policy steps that it lasts, 0: no end
    command_steps: int  # policy steps since the command
    command_lasts: int  # policy steps from this command to the next, 0: it stays
    pace: float  # gait cycles per policy step, 0: no gait clock
    phase: float  # of the gait's cycle, 0 to 1
    recent: vec4l  # per paw, bit i: the paw touched down i policy steps ago, i < 45
    recent_steps: wp.vec4  # number of touchdowns of each paw in the last 0.75 s
    swing_height: wp.vec4  # [m] largest height of each paw above the ground in its present swing, 0 in contact
    error_xy: float  # [m/s] sum of horizontal velocity errors over the episode's settled policy steps
    error_yaw: float  # [rad/s] sum of absolute yaw rate errors over them
    settled: float  # number of settled policy steps: those long enough after a command
    command_level: int  # level of the command curriculum
    terrain_level: int  # level of the terrain curriculum (row of the map)
    limit: wp.vec2  # [m] half extents of the map along x, y, 0: no map
    sum_xy: float  # [m/s] sum of horizontal velocity errors over settled policy steps
    sum_yaw: float  # [rad/s] sum of absolute yaw rate errors over them
    sum_settled: float  # number of settled policy steps
    score: float  # [m/s] sum over them of commanded speed less twice the error, weighted by the terrain level
    all_steps: float  # policy steps
    minutes: float  # [min] simulated
    seconds_walking: float  # [s] simulated with a command to move
    falls: float  # episodes that ended with failure
    touchdowns: float  # touchdowns per paw (0.25 for each) while commanded to move
    apexes: float  # [m] sum of `swing_height` at these touchdowns, times 0.25


@wp.func
def velocity_error(robot: RobotView, state: VelocityState) -> wp.vec3:
    """Return velocity minus command: ahead [m/s], to the left [m/s], yaw rate [rad/s], body axes."""
    vel = wp.quat_rotate_inv(robot.quat, robot.lin_vel)
    return wp.vec3(vel[0] - state.command[0], vel[1] - state.command[1], robot.ang_vel[2] - state.command[2])


@wp.func
def update_step_counts(robot: RobotView, state: VelocityState) -> VelocityState:
    """Return the task state with the paws' touchdowns and swing heights of this policy step included.

    `recent` holds one bit per policy step and paw: a touchdown enters at bit 0 and leaves `recent_steps` 45 steps
    (0.75 s) later.
    """
    t = state
    for k in range(4):
        touchdown = robot.first_contact[k]
        oldest = (state.recent[k] >> wp.int64(44)) & wp.int64(1)
        shifted = (state.recent[k] << wp.int64(1)) & wp.int64(35184372088831)  # 2^45 - 1
        t.recent[k] = shifted | wp.int64(touchdown)
        t.recent_steps[k] = state.recent_steps[k] + touchdown - float(oldest)
        if touchdown > 0.0 and state.standing == 0:
            t.touchdowns = t.touchdowns + 0.25
            t.apexes = t.apexes + 0.25 * state.swing_height[k]
        t.swing_height[k] = wp.where(robot.contact[k] > 0.0, 0.0, wp.max(state.swing_height[k], robot.paw_height[k]))
    return t


@wp.func
def advance_velocity(robot: RobotView, state: VelocityState, settle: float) -> VelocityState:
    """Return the state of velocity tracking (errors, step counts, gait phase) updated by one policy step.

    Errors count only when more than `settle` policy steps have passed since the command: a robot needs time to change
    its speed. `score` compares policies during training. It grows with commanded speed and terrain level, so that a
    policy on an easy level is not taken for a better one.
    """
    t = update_step_counts(robot, state)
    t.steps = state.steps + 1
    t.command_steps = state.command_steps + 1
    phase = state.phase + state.pace
    t.phase = phase - wp.floor(phase)
    t.all_steps = state.all_steps + 1.0
    t.minutes = state.minutes + 1.0 / (60.0 * POLICY_RATE)
    if state.standing == 0:
        t.seconds_walking = state.seconds_walking + 1.0 / POLICY_RATE
    error = velocity_error(robot, state)
    xy = wp.length(wp.vec2(error[0], error[1]))
    yaw = wp.abs(error[2])
    finite = xy < MAX_COUNTED_ERROR and yaw < MAX_COUNTED_ERROR  # both false for NaN
    if t.command_steps > whole_steps(settle) and finite:
        speed = wp.length(wp.vec2(state.command[0], state.command[1])) + 0.3 * wp.abs(state.command[2])
        t.error_xy = state.error_xy + xy
        t.error_yaw = state.error_yaw + yaw
        t.settled = state.settled + 1.0
        t.sum_xy = state.sum_xy + xy
        t.sum_yaw = state.sum_yaw + yaw
        t.sum_settled = state.sum_settled + 1.0
        t.score = state.score + (speed - 2.0 * (xy + 0.3 * yaw)) * (1.0 + 0.1 * float(state.terrain_level))
    return t


@wp.func
def mean_error(state: VelocityState) -> float:
    """Return the episode's mean velocity error [m/s]: horizontal error + 0.3 m times yaw rate error [rad/s]."""
    return (state.error_xy + 0.3 * state.error_yaw) / wp.max(state.settled, 1.0)


@wp.func
def tracking_error(robot: RobotView, state: VelocityState) -> float:
    """Return the episode's mean velocity error [m/s]; `robot` is unused (signature of curriculum errors)."""
    return mean_error(state)


@wp.func
def every_episode(state: VelocityState) -> bool:
    """Return True, since every episode counts for the curriculum."""
    return True
