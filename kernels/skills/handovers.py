"""Handovers between walking and jumping: conditions (`*_due`) and initial task states (`begin_*`).

Neither function changes the robot's state. requested: whether `Env.request` requested the target skill. A skill takes
over in states like those from which its training starts, or where the other skill has failed. World z is up, policy
steps last 1/60 s.
"""

import warp as wp

from ..jump.state import LANDED, STANCE, JumpState
from ..mdp.durations import NEVER
from ..mdp.view import RobotView, tilt, yaw_of
from ..velocity.state import VelocityState

wp.set_module_options({"enable_backward": False})

REST_SPEED = wp.constant(0.10)  # [m/s] largest speed of a base at rest
REST_SPIN = wp.constant(0.30)  # [rad/s] largest angular speed of a base at rest
MAX_STAND_TILT = wp.constant(0.14)  # [rad] of a standing base
MAX_OFFSET = wp.constant(0.44)  # [rad] of a motor from the default pose, to be near it
MIN_STAND_TIME = wp.constant(0.3)  # [s] of contact of each paw of a standing robot
LOST_TILT = wp.constant(0.35)  # [rad] tilt after touchdown beyond which walking takes over
LANDED_STEPS = wp.constant(18)  # policy steps after touchdown before which walking never takes over
RECOVER_STEPS = wp.constant(60)  # policy steps after touchdown after which walking takes over in any state
NO_JUMP_STEPS = wp.constant(150)  # policy steps in stance after which walking takes over without a jump


@wp.func
def at_rest(robot: RobotView) -> bool:
    """Return whether a robot stands still: four paws down for MIN_STAND_TIME, base level and nearly motionless."""
    return (
        robot.contacts == 4
        and wp.min(robot.contact_time) > MIN_STAND_TIME
        and wp.length(robot.lin_vel) < REST_SPEED
        and wp.length(robot.ang_vel) < REST_SPIN
        and tilt(robot) < MAX_STAND_TILT
    )


@wp.func
def near_default(robot: RobotView) -> bool:
    """Return whether all motors are within MAX_OFFSET of the default pose."""
    largest = float(0.0)
    for m in range(12):
        largest = wp.max(largest, wp.abs(robot.angle[m] - robot.default_angle[m]))
    return largest < MAX_OFFSET


@wp.func
def walk_to_jump_due(robot: RobotView, state: VelocityState, requested: bool) -> bool:
    """Return whether a requested jump takes over from walking: at rest, commanded to stand, near the default pose."""
    return requested and state.standing == 1 and at_rest(robot) and near_default(robot)


@wp.func
def jump_to_walk_due(robot: RobotView, state: JumpState, requested: bool) -> bool:
    """Return whether walking takes over from a jump: when the robot is at rest after landing, or the jump went wrong.

    No request is needed. The jump went wrong if the robot is tilted after landing or not at rest within RECOVER_STEPS,
    or if it has not taken off within NO_JUMP_STEPS.
    """
    if state.phase == LANDED:
        over = at_rest(robot) or tilt(robot) > LOST_TILT or state.phase_steps >= RECOVER_STEPS
        return state.phase_steps >= LANDED_STEPS and over
    return state.phase == STANCE and state.steps >= NO_JUMP_STEPS


@wp.func
def begin_walk(robot: RobotView, state: JumpState) -> VelocityState:
    """Return the initial state of walking after a jump, commanded to stand; the arguments are unused."""
    new = VelocityState()
    new.standing = 1
    return new


@wp.func
def begin_jump(robot: RobotView, state: VelocityState) -> JumpState:
    """Return the initial state of a jump after walking, not commanded yet; the handover sets a requested command."""
    new = JumpState()
    new.heading = yaw_of(robot.quat)
    new.start = robot.pos
    new.goal = robot.pos
    new.goal_ground = robot.pos[2] - robot.height
    new.max_height = robot.pos[2]
    new.command_step = NEVER
    return new
