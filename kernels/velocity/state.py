"""The state of velocity tracking, and how it moves on by a policy step."""

import warp as wp

from ..mdp.view import RobotView

POLICY_RATE = wp.constant(60.0)  # policy steps in a second
ABSURD = wp.constant(40.0)  # [m/s], [rad/s] an error of a world that came apart
vec4l = wp.types.vector(length=4, dtype=wp.int64)


@wp.struct
class VelocityState:
    """State of one world's episode. What is counted goes on over episodes until it is read."""

    command: wp.vec3  # [m/s], [m/s], [rad/s] wanted velocity ahead, to the left and about z, body axes
    standing: int  # 1: commanded to stand
    steps: int  # policy steps since the episode began
    episode_steps: int  # policy steps that it lasts, 0: no end
    command_steps: int  # policy steps since the command
    command_lasts: int  # policy steps from this command to the next, 0: it stays
    pace: float  # cycles of the gait in a policy step, 0: no clock
    phase: float  # of the gait's cycle, 0 to 1
    recent: vec4l  # bit i: the paw came down i policy steps ago, for 45 policy steps
    recent_steps: wp.vec4  # how often each paw came down in the last 0.75 s
    swing_height: wp.vec4  # [m] highest that each paw has been above the ground since it left it
    error_xy: float  # [m/s] sum over settled policy steps of the episode
    error_yaw: float  # [rad/s]
    settled: float  # policy steps that these sums are of
    command_level: int  # of the curriculum of commands
    terrain_level: int  # of that of the ground
    limit: wp.vec2  # [m] base beyond it along x or y has left the map, 0: no map
    sum_xy: float  # [m/s] of errors in settled policy steps, counted
    sum_yaw: float  # [rad/s]
    sum_settled: float  # policy steps
    score: float  # [m/s] commanded speed less twice the error, more on harder ground
    all_steps: float  # policy steps
    minutes: float  # [min] simulated
    seconds_walking: float  # [s] simulated with a command to move
    falls: float  # episodes that ended with failure
    touchdowns: float  # of a quarter of the paws, while commanded to move
    apexes: float  # [m] sum of their swings' highest points


@wp.func
def velocity_error(robot: RobotView, state: VelocityState) -> wp.vec3:
    """Return velocity minus command: ahead [m/s], to the left [m/s], yaw rate [rad/s], body axes."""
    vel = wp.quat_rotate_inv(robot.quat, robot.lin_vel)
    return wp.vec3(vel[0] - state.command[0], vel[1] - state.command[1], robot.ang_vel[2] - state.command[2])


@wp.func
def follow_steps(robot: RobotView, state: VelocityState) -> VelocityState:
    """Return the state with updated step counts and swing heights of the paws."""
    t = state
    for k in range(4):
        came_down = robot.first_contact[k]
        oldest = (state.recent[k] >> wp.int64(44)) & wp.int64(1)
        kept = (state.recent[k] << wp.int64(1)) & wp.int64(35184372088831)  # 2^45 - 1
        t.recent[k] = kept | wp.int64(came_down)
        t.recent_steps[k] = state.recent_steps[k] + came_down - float(oldest)
        if came_down > 0.0 and state.standing == 0:
            t.touchdowns = t.touchdowns + 0.25
            t.apexes = t.apexes + 0.25 * state.swing_height[k]
        t.swing_height[k] = wp.where(robot.contact[k] > 0.0, 0.0, wp.max(state.swing_height[k], robot.paw_height[k]))
    return t


@wp.func
def advance_velocity(robot: RobotView, state: VelocityState, settle: float) -> VelocityState:
    """Return the state one policy step later; errors count from `settle` policy steps after a command on."""
    t = follow_steps(robot, state)
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
    if t.command_steps > int(settle) and xy < ABSURD and yaw < ABSURD:  # both false if not a number
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
    """Return the episode's mean error [m/s]: of the velocity in the plane, and 0.3 m of that of the yaw rate."""
    return (state.error_xy + 0.3 * state.error_yaw) / wp.max(state.settled, 1.0)


@wp.func
def tracking_error(robot: RobotView, state: VelocityState) -> float:
    """Mean error of the episode [m/s]."""
    return mean_error(state)


@wp.func
def every_episode(state: VelocityState) -> bool:
    """Return True: the curriculum counts every episode."""
    return True
