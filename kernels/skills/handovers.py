"""When walking, jumping and turning in flight follow each other, and how each begins; the robot is left as it is."""

import warp as wp

from ..attitude.state import AttitudeState, with_goal
from ..jump.phase import time_to_height
from ..jump.state import FLIGHT, LANDED, STANCE, JumpState
from ..mdp.view import RobotView, tilt, yaw_of
from ..velocity.state import VelocityState

wp.set_module_options({"enable_backward": False})

REST_SPEED = wp.constant(0.10)  # [m/s] of a base at rest
REST_SPIN = wp.constant(0.30)  # [rad/s]
LEVEL = wp.constant(0.14)  # [rad] tilt of a base that stands
NEAR = wp.constant(0.44)  # [rad] motors farther from the default pose are not near it
PLANTED = wp.constant(0.3)  # [s] that a paw has been down
FALLING = wp.constant(0.35)  # [rad] tilt at which walking takes over from a landing
LANDED_STEPS = wp.constant(18)  # policy steps after touchdown before which a landing is not over
RECOVER_STEPS = wp.constant(60)  # policy steps after touchdown after which walking takes over
NO_JUMP_STEPS = wp.constant(150)  # policy steps without a takeoff after which it does
FREE_STEPS = wp.constant(2)  # policy steps after a takeoff after which turning takes over
LANDING_TIME = wp.constant(0.35)  # [s] before a base falls through LANDING_HEIGHT, in which the jump lands
LANDING_HEIGHT = wp.constant(0.45)  # [m] of the base above the ground
NEVER = wp.constant(1_000_000)  # policy step of a command that has not come


@wp.func
def at_rest(robot: RobotView) -> bool:
    """Return whether a robot stands: on four paws for a while, the base level, slow and not turning."""
    return (
        robot.contacts == 4
        and wp.min(robot.contact_time) > PLANTED
        and wp.length(robot.lin_vel) < REST_SPEED
        and wp.length(robot.ang_vel) < REST_SPIN
        and tilt(robot) < LEVEL
    )


@wp.func
def near_default(robot: RobotView) -> bool:
    """Return whether all motors are near the default pose."""
    most = float(0.0)
    for m in range(12):
        most = wp.max(most, wp.abs(robot.angle[m] - robot.default_angle[m]))
    return most < NEAR


@wp.func
def come_to_a_stop(robot: RobotView, state: VelocityState, requested: bool) -> bool:
    """Walking to a jump: asked for, commanded to stand, at rest, and near the default pose."""
    return requested and state.standing == 1 and at_rest(robot) and near_default(robot)


@wp.func
def landed_or_lost(robot: RobotView, state: JumpState, requested: bool) -> bool:
    """A jump to walking: landed and at rest; or as recovery, landed badly, not at rest in time or not taken off."""
    if state.phase == LANDED:
        over = at_rest(robot) or tilt(robot) > FALLING or state.phase_steps >= RECOVER_STEPS
        return state.phase_steps >= LANDED_STEPS and over
    return state.phase == STANCE and state.steps >= NO_JUMP_STEPS


@wp.func
def begin_walk(robot: RobotView, state: JumpState) -> VelocityState:
    """Return the state of walking, commanded to stand."""
    new = VelocityState()
    new.standing = 1
    return new


@wp.func
def begin_jump(robot: RobotView, state: VelocityState) -> JumpState:
    """Return the state of a jump whose command has not come; that of the request is given at once."""
    new = JumpState()
    new.heading = yaw_of(robot.quat)
    new.start = robot.pos
    new.goal = robot.pos
    new.goal_ground = robot.pos[2] - robot.height
    new.max_height = robot.pos[2]
    new.command_step = NEVER
    return new


@wp.func
def in_flight(robot: RobotView, state: JumpState, requested: bool) -> bool:
    """A jump to turning: asked for, and in flight."""
    return requested and state.phase == FLIGHT and state.phase_steps >= FREE_STEPS


@wp.func
def about_to_land(robot: RobotView, state: AttitudeState, requested: bool) -> bool:
    """Turning to the jump: down soon, or down."""
    if robot.contacts > 0:
        return True
    if robot.gravity_magnitude <= 0.0 or robot.lin_vel[2] > 0.0:
        return False
    left = time_to_height(robot.height, robot.lin_vel[2], LANDING_HEIGHT, robot.gravity_magnitude)
    return left < LANDING_TIME or robot.height < LANDING_HEIGHT


@wp.func
def begin_turn(robot: RobotView, state: JumpState) -> AttitudeState:
    """Return the state of a turn that brings the robot level, in the heading of its jump."""
    new = AttitudeState()
    new.jump_start = state.start
    new.jump_goal = state.goal
    new.goal_ground = state.goal_ground
    new.max_height = state.max_height
    return with_goal(new, robot.quat, wp.quat_from_axis_angle(wp.vec3(0.0, 0.0, 1.0), state.heading))


@wp.func
def begin_landing(robot: RobotView, state: AttitudeState) -> JumpState:
    """Return the state of the jump that turning was part of, in flight past its apex."""
    new = JumpState()
    new.phase = FLIGHT
    new.start = state.jump_start
    new.goal = state.jump_goal
    new.goal_ground = state.goal_ground
    new.heading = yaw_of(state.goal)
    new.max_height = state.max_height
    new.apex_passed = 1
    new.steps = 1
    return new
