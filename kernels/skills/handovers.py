"""When walking, standing and jumping follow each other, and how each begins; the robot itself is left as it is."""

import warp as wp

from ..jump.state import LANDED, STANCE, JumpState
from ..mdp.view import RobotView, tilt, turned, yaw_of
from ..velocity.state import VelocityState
from .stand import BLEND, StandState

wp.set_module_options({"enable_backward": False})

STOPPED = wp.constant(0.15)  # [m/s] base slower than this comes to a stop
REST_SPEED = wp.constant(0.10)  # [m/s] of a base at rest
REST_SPIN = wp.constant(0.30)  # [rad/s]
LEVEL = wp.constant(0.14)  # [rad] tilt of a base that stands
FALLING = wp.constant(0.35)  # [rad] tilt at which walking takes over after a landing
NEAR = wp.constant(0.44)  # [rad] motors farther from the default pose are not near it
PLANTED = wp.constant(0.15)  # [s] that a paw has been down
LANDED_STEPS = wp.constant(18)  # policy steps after touchdown before which a landing is not over
RECOVER_STEPS = wp.constant(60)  # policy steps after touchdown, or of waiting, after which walking takes over
NO_JUMP_STEPS = wp.constant(150)  # policy steps without a takeoff


@wp.func
def planted(view: RobotView) -> bool:
    """Return whether all paws have been on the ground for a while."""
    return view.contacts == 4 and wp.min(view.contact_time) > PLANTED


@wp.func
def resting(view: RobotView, speed: float, spin: float) -> bool:
    """Return whether the base is level and slower than a speed [m/s] and a spin [rad/s]."""
    return wp.length(view.lin_vel) < speed and wp.length(view.ang_vel) < spin and tilt(view) < LEVEL


@wp.func
def near_default(view: RobotView) -> bool:
    """Return whether all motors are near the default pose."""
    most = float(0.0)
    for m in range(12):
        most = wp.max(most, wp.abs(view.sensed_angle[m] - view.default_angle[m]))
    return most < NEAR


@wp.func
def come_to_a_stop(view: RobotView, task: VelocityState, requested: bool) -> bool:
    """Walking to standing: asked for, commanded to stand, on four paws near the default pose, and slow."""
    return (
        requested
        and task.standing == 1
        and planted(view)
        and near_default(view)
        and resting(view, STOPPED, 2.0 * REST_SPIN)
    )


@wp.func
def ready_to_jump(view: RobotView, task: StandState, requested: bool) -> bool:
    """Standing to a jump: asked for, targets in the default pose, on four paws, and at rest."""
    return requested and task.steps >= BLEND and planted(view) and resting(view, REST_SPEED, REST_SPIN)


@wp.func
def walk_again(view: RobotView, task: StandState, requested: bool) -> bool:
    """Standing to walking: asked for, or not at rest for a second, or about to fall."""
    return requested or task.steps >= BLEND + RECOVER_STEPS or tilt(view) > FALLING


@wp.func
def landed_or_lost(view: RobotView, task: JumpState, requested: bool) -> bool:
    """A jump to walking: landed and at rest; or as recovery, landed badly, not at rest in time or not taken off."""
    if task.phase == LANDED:
        if tilt(view) > FALLING or task.phase_steps >= RECOVER_STEPS:
            return True
        return task.phase_steps >= LANDED_STEPS and planted(view) and resting(view, REST_SPEED, REST_SPIN)
    return task.phase == STANCE and task.steps >= NO_JUMP_STEPS


@wp.func
def begin_stand(view: RobotView, task: VelocityState) -> StandState:
    """Return the state of a stand that holds the targets as they are at first."""
    return StandState()


@wp.func
def begin_walk(view: RobotView, task: StandState) -> VelocityState:
    """Return the state of walking, commanded to stand."""
    new = VelocityState()
    new.standing = 1
    return new


@wp.func
def begin_walk_after_jump(view: RobotView, task: JumpState) -> VelocityState:
    """Return the state of walking after a jump, commanded to stand."""
    new = VelocityState()
    new.standing = 1
    return new


@wp.func
def begin_jump(view: RobotView, task: StandState) -> JumpState:
    """Return the state of a jump that is commanded at once, to the goal that the stand was told."""
    new = JumpState()
    new.heading = yaw_of(view.quat)
    new.start = view.pos
    new.goal = turned(task.goal, new.heading) + wp.vec3(view.pos[0], view.pos[1], 0.0)
    new.goal_ground = view.pos[2] - view.height
    new.max_height = view.pos[2]
    return new
