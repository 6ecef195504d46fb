"""What a task's rewards, terminations and observations may read: the robot's state, and the jump's."""

import warp as wp

from ..layout import BODIES, COORDS, DOFS, motor_slot
from ..terrain.ground import Ground, surface, world_ground

vec12 = wp.types.vector(length=12, dtype=wp.float32)

STANCE = wp.constant(0)
FLIGHT = wp.constant(1)
LANDED = wp.constant(2)


@wp.struct
class RobotView:
    """The robot at the end of a policy step; motors in the order FL, FR, BL, BR by lateral, outer, inner."""

    pos: wp.vec3  # [m] base origin, world
    height: float  # [m] of the base origin above the ground below it
    quat: wp.quat  # xyzw, body to world
    lin_vel: wp.vec3  # [m/s] base origin, world
    lin_acc: wp.vec3  # [m/s^2] base origin, world, mean of the policy step
    ang_vel: wp.vec3  # [rad/s] body axes
    gravity: wp.vec3  # [1] direction of gravity in body axes
    angle: vec12  # [rad]
    rate: vec12  # [rad/s]
    rate_change: vec12  # [rad/s^2] mean of the policy step
    torque: vec12  # [N m] last physics step
    action: vec12  # [1] within -1..1
    old_action: vec12
    clipped: float  # [rad^2] squared distance that the command filter moved the targets
    paw_force: wp.vec4  # [N] on each paw
    contacts: int  # number of paws on the ground
    collisions: int  # bits of `collision`
    default_angle: vec12  # [rad]


@wp.struct
class JumpTask:
    """State of one world's episode."""

    goal: wp.vec3  # [m] where to land: base x, y; and its wanted height at the apex, 0 if any will do
    start: wp.vec3  # [m] base origin where the jump began
    goal_ground: float  # [m] height of the ground there
    heading: float  # [rad] yaw of the jump
    phase: int  # STANCE, FLIGHT, LANDED
    steps: int  # policy steps since the episode began
    phase_steps: int  # policy steps in this phase
    command_step: int  # policy step from which the jump is commanded
    idle_steps: int  # policy steps without motion while a jump was commanded
    took_off: int  # 1 in the step of the takeoff
    touched_down: int  # 1 in the step of the touchdown
    at_apex: int  # 1 in the step in which the base begins to fall
    apex_passed: int
    max_height: float  # [m] of the base since takeoff
    touchdown_vel: wp.vec3  # [m/s] of the base, step before touchdown
    peak_tilt: float  # [rad] largest between body and world z since touchdown
    scheme: int  # reset scheme that began the episode
    again_step: int  # policy steps after touchdown at which another goal comes, 0: never
    jumps: int  # jumps that were followed by another in this episode
    level: int  # curriculum
    streak: int  # successes in a row


@wp.struct
class ViewArrays:
    """Where the robot's state is read from; the old_ arrays hold the values of the policy step before."""

    joint_q: wp.array(dtype=float)
    joint_qd: wp.array(dtype=float)
    body_com: wp.array(dtype=wp.vec3)
    paw_force: wp.array2d(dtype=wp.vec3)  # [N] (4, num_worlds)
    torque: wp.array2d(dtype=float)  # (12, num_worlds), like all below
    action: wp.array2d(dtype=float)
    old_action: wp.array2d(dtype=float)
    target: wp.array2d(dtype=float)  # [rad] before the filter
    safe_target: wp.array2d(dtype=float)  # [rad] after it
    old_rate: wp.array2d(dtype=float)
    old_lin_vel: wp.array(dtype=wp.vec3)  # (num_worlds,)
    default_angle: wp.array(dtype=float)  # (12,)
    step_dt: float  # [s] policy step


@wp.func
def base_velocity(arrays: ViewArrays, world: int, quat: wp.quat) -> wp.vec3:
    """Return the velocity of the base origin [m/s], world frame."""
    i = world * DOFS
    com_vel = wp.vec3(arrays.joint_qd[i], arrays.joint_qd[i + 1], arrays.joint_qd[i + 2])
    ang = wp.vec3(arrays.joint_qd[i + 3], arrays.joint_qd[i + 4], arrays.joint_qd[i + 5])
    return com_vel - wp.cross(ang, wp.quat_rotate(quat, arrays.body_com[world * BODIES]))


@wp.func
def load_base_view(arrays: ViewArrays, world: int) -> RobotView:
    """Return the view with the base's entries filled in."""
    i = world * COORDS
    j = world * DOFS
    view = RobotView()
    view.pos = wp.vec3(arrays.joint_q[i], arrays.joint_q[i + 1], arrays.joint_q[i + 2])
    quat = wp.quat(arrays.joint_q[i + 3], arrays.joint_q[i + 4], arrays.joint_q[i + 5], arrays.joint_q[i + 6])
    view.quat = quat
    view.lin_vel = base_velocity(arrays, world, quat)
    view.lin_acc = (view.lin_vel - arrays.old_lin_vel[world]) / arrays.step_dt
    ang = wp.vec3(arrays.joint_qd[j + 3], arrays.joint_qd[j + 4], arrays.joint_qd[j + 5])
    view.ang_vel = wp.quat_rotate_inv(quat, ang)
    view.gravity = wp.quat_rotate_inv(quat, wp.vec3(0.0, 0.0, -1.0))
    return view


@wp.func
def load_view(arrays: ViewArrays, ground: Ground, world: int, contact_force: float) -> RobotView:
    """Return the robot of a world, without collisions; paws pressed harder than `contact_force` [N] are in contact."""
    view = load_base_view(arrays, world)
    below = surface(world_ground(ground, world), view.pos[0], view.pos[1])
    view.height = view.pos[2] - below[0]
    contacts = int(0)
    for k in range(4):
        force = wp.length(arrays.paw_force[k, world])
        view.paw_force[k] = force
        if force > contact_force:
            contacts += 1
    view.contacts = contacts
    clipped = float(0.0)
    for m in range(12):
        slot = motor_slot(m)
        rate = arrays.joint_qd[world * DOFS + 6 + slot]
        view.angle[m] = arrays.joint_q[world * COORDS + 7 + slot]
        view.rate[m] = rate
        view.rate_change[m] = (rate - arrays.old_rate[m, world]) / arrays.step_dt
        view.torque[m] = arrays.torque[m, world]
        view.action[m] = arrays.action[m, world]
        view.old_action[m] = arrays.old_action[m, world]
        view.default_angle[m] = arrays.default_angle[m]
        off = arrays.target[m, world] - arrays.safe_target[m, world]
        clipped += off * off
    view.clipped = clipped
    return view


@wp.func
def speed_limit_broken(view: RobotView) -> bool:
    """Return whether a state is non-finite or faster than the robot can ever be: the world has come apart."""
    fastest = float(0.0)
    total = wp.length_sq(view.pos) + wp.length_sq(view.lin_vel) + wp.length_sq(view.ang_vel)
    for m in range(12):
        fastest = wp.max(fastest, wp.abs(view.rate[m]))
        total += view.rate[m] * view.rate[m] + view.angle[m] * view.angle[m]  # max() would pass over a NaN
    if not wp.isfinite(total):
        return True
    return wp.length(view.lin_vel) > 15.0 or wp.length(view.ang_vel) > 40.0 or fastest > 120.0


@wp.func
def yaw_of(quat: wp.quat) -> float:
    """Return the yaw [rad] of an orientation (xyzw): the heading of body x in the world plane."""
    ahead = wp.quat_rotate(quat, wp.vec3(1.0, 0.0, 0.0))
    return wp.atan2(ahead[1], ahead[0])


@wp.func
def rotation_from(quat: wp.quat, heading: float) -> float:
    """Return the angle [rad] between an orientation (xyzw) and the level one with a heading [rad]."""
    half = 0.5 * heading
    level = wp.quat(0.0, 0.0, wp.sin(half), wp.cos(half))
    off = wp.quat_inverse(level) * quat
    return 2.0 * wp.atan2(wp.length(wp.vec3(off[0], off[1], off[2])), wp.abs(off[3]))


@wp.func
def goal_offset(view: RobotView, task: JumpTask) -> wp.vec3:
    """Return the horizontal way from the base to the goal [m], world axes."""
    return wp.vec3(task.goal[0] - view.pos[0], task.goal[1] - view.pos[1], 0.0)


@wp.func
def commanded(task: JumpTask) -> bool:
    """Return whether a jump is asked for and not yet landed (the paper's c)."""
    return task.steps >= task.command_step and task.phase != LANDED


@wp.func
def waiting(task: JumpTask) -> bool:
    """Return whether a jump is asked for but the robot still stands."""
    return task.phase == STANCE and task.steps >= task.command_step
