"""State of a robot that rewards, terminations and observations read (`RobotView`), and its arrays (`RobotArrays`).

A view gathers one robot's values in the form that terms need, so that a term indexes no arrays. World z is up; body
axes are x ahead, y left, z up; quaternions are xyzw, body to world. Lateral angles are positive outward, outer and
inner ones away from the leg's other thigh.
"""

import warp as wp

from ..layout import BODIES, COORDS, DOFS, motor_slot
from ..terrain.ground import Ground, surface, world_ground

vec12 = wp.types.vector(length=12, dtype=wp.float32)
mat43 = wp.types.matrix(shape=(4, 3), dtype=wp.float32)


@wp.struct
class RobotView:
    """State of one robot at the end of a policy step. Legs: FL, FR, BL, BR; motors of a leg: lateral, outer, inner.

    Bits of `collisions`: 1 shell, 2 motor housing, 4 thigh, 8 knee, 16 shank touches the ground; 32 legs touch each
    other, 64 links of one leg, 128 leg and shell.
    """

    world: int  # index of the world
    pos: wp.vec3  # [m] position of the base origin, world
    height: float  # [m] height of the base origin above the ground below it
    quat: wp.quat  # [1] orientation of the base (xyzw), body to world
    lin_vel: wp.vec3  # [m/s] velocity of the base origin, world
    prev_lin_vel: wp.vec3  # [m/s] `lin_vel` of the previous policy step, world
    lin_acc: wp.vec3  # [m/s^2] acceleration of the base origin, mean over the policy step, world
    ang_vel: wp.vec3  # [rad/s] angular velocity of the base, body axes
    projected_gravity: wp.vec3  # [1] direction of gravity, body axes
    gravity_magnitude: float  # [m/s^2] downward acceleration of gravity
    angle: vec12  # [rad] motor angles
    sensed_angle: vec12  # [rad] motor angles with the errors of the position sensors
    rate: vec12  # [rad/s] motor speeds: time derivatives of `angle`
    joint_acc: vec12  # [rad/s^2] motor accelerations, mean over the policy step
    torque: vec12  # [N m] motor torques of the last physics step
    prev_torque: vec12  # [N m] motor torques of the last physics step in the previous policy step
    action: vec12  # [1] action of the policy, within -1..1
    prev_action: vec12  # [1] action one policy step earlier
    prev_prev_action: vec12  # [1] action two policy steps earlier
    clipped: float  # [rad^2] sum over motors of the squared change of the target by the command filter
    default_angle: vec12  # [rad] motor angles of the default pose
    contacts: int  # number of paws on the ground
    collisions: int  # bits of all collisions
    contact: wp.vec4  # [1] 1 for a paw on the ground, else 0
    first_contact: wp.vec4  # [1] 1 for a paw that touched down in this step, else 0
    air_time: wp.vec4  # [s] time since each paw left the ground; in the step of a touchdown the whole swing, later 0
    contact_time: wp.vec4  # [s] time since each paw touched down; 0 in the air
    touchdown_speed: wp.vec4  # [m/s] downward speed of each paw one policy step before its last touchdown
    paw_force: wp.vec4  # [N] size of the contact force on each paw in the last physics step
    peak_force: wp.vec4  # [N] largest contact force on each paw during the policy step
    paw_pos: mat43  # [m] position of each paw's centre, one paw a row, world
    paw_vel: mat43  # [m/s] velocity of each paw's centre, one paw a row, world
    paw_height: wp.vec4  # [m] height of each paw's lowest point above the ground; 0 before the first step


@wp.struct
class RobotArrays:
    """State of all robots, in Python `env.robot`; the `prev_` arrays hold the values of the previous policy step.

    NumPy appends an axis for vectors: `env.robot.paw_pos.numpy()` has shape (4, num_worlds, 3), a `RobotView` (4, 3).
    `joint_q` has 43 numbers a world: position and quaternion of the base, five angles a leg (lateral, outer, outer
    knee, inner, inner knee), and a quaternion of each ankle's loop joint. `joint_qd` has 38, three for a quaternion.
    """

    joint_q: wp.array(dtype=float)  # (COORDS num_worlds,) base position [m], quaternion (xyzw), joint angles [rad]
    joint_qd: wp.array(dtype=float)  # (DOFS num_worlds,) base com [m/s], angular velocity, joints [rad/s]; world axes
    body_com: wp.array(dtype=wp.vec3)  # [m] (BODIES num_worlds,) centre of mass of each body, body axes
    body_f: wp.array(dtype=wp.spatial_vector)  # [N], [N m] wrench on each body at its com, world axes
    gravity: wp.array(dtype=wp.vec3)  # [m/s^2] (num_worlds + 1,), world axes
    diverged: wp.array(dtype=int)  # (num_worlds,) 1: the solver froze the world because its state diverged
    impulse: wp.array2d(dtype=wp.vec3)  # [N s] (4, num_worlds) contact impulses, first guess of the next physics step
    paw_force: wp.array2d(dtype=wp.vec3)  # [N] (4, num_worlds) contact force on each paw, last physics step, world axes
    peak_force: wp.array2d(dtype=float)  # [N] (4, num_worlds) largest contact force of the policy step
    paw_pos: wp.array2d(dtype=wp.vec3)  # [m] (4, num_worlds) centre of each paw, world
    paw_vel: wp.array2d(dtype=wp.vec3)  # [m/s] (4, num_worlds) centre of each paw, world
    contact_time: wp.array2d(dtype=float)  # [s] (4, num_worlds) since touchdown; 0 in the air
    air_time: wp.array2d(dtype=float)  # [s] (4, num_worlds) as in `RobotView`
    touchdown_speed: wp.array2d(dtype=float)  # [m/s] (4, num_worlds) as in `RobotView`
    collisions: wp.array2d(dtype=int)  # (4, num_worlds) bits of each leg, see `RobotView`
    torque: wp.array2d(dtype=float)  # [N m] (12, num_worlds) last physics step
    prev_torque: wp.array2d(dtype=float)  # [N m] (12, num_worlds)
    action: wp.array2d(dtype=float)  # [1] (12, num_worlds) within -1..1
    prev_action: wp.array2d(dtype=float)  # [1] (12, num_worlds)
    prev_prev_action: wp.array2d(dtype=float)  # [1] (12, num_worlds) two policy steps earlier
    target: wp.array2d(dtype=float)  # [rad] (12, num_worlds) motor targets before the filter
    filtered_target: wp.array2d(dtype=float)  # [rad] (12, num_worlds) motor targets after the filter
    prev_rate: wp.array2d(dtype=float)  # [rad/s] (12, num_worlds) motor rates
    joint_offset: wp.array2d(dtype=float)  # [rad] (12, num_worlds) constant error of each motor's position sensor
    prev_lin_vel: wp.array(dtype=wp.vec3)  # [m/s] (num_worlds,) base origin, world
    default_angle: wp.array(dtype=float)  # [rad] (12,) motor angles of the default pose
    step_dt: float  # [s] policy step
    paw_height: wp.array2d(dtype=float)  # [m] (4, num_worlds) above the ground


@wp.func
def base_velocity(arrays: RobotArrays, world: int, quat: wp.quat) -> wp.vec3:
    """Return the velocity of a world's base origin [m/s], world axes; quat: its orientation (xyzw, body to world)."""
    i = world * DOFS
    com_vel = wp.vec3(arrays.joint_qd[i], arrays.joint_qd[i + 1], arrays.joint_qd[i + 2])
    ang = wp.vec3(arrays.joint_qd[i + 3], arrays.joint_qd[i + 4], arrays.joint_qd[i + 5])
    return com_vel - wp.cross(ang, wp.quat_rotate(quat, arrays.body_com[world * BODIES]))


@wp.func
def base_pos(arrays: RobotArrays, world: int) -> wp.vec3:
    """Return the position of a world's base origin [m], world frame."""
    i = world * COORDS
    return wp.vec3(arrays.joint_q[i], arrays.joint_q[i + 1], arrays.joint_q[i + 2])


@wp.func
def base_quat(arrays: RobotArrays, world: int) -> wp.quat:
    """Return the orientation of a world's base (xyzw, body to world)."""
    i = world * COORDS + 3
    return wp.quat(arrays.joint_q[i], arrays.joint_q[i + 1], arrays.joint_q[i + 2], arrays.joint_q[i + 3])


@wp.func
def load_base_view(arrays: RobotArrays, ground: Ground, world: int) -> RobotView:
    """Return the state of a world's robot (`RobotView`) with the values of the base only; motors and paws are 0.

    Newton's joint_qd has the velocity of the base's centre of mass and the angular velocity in world axes; the view has
    the velocity of the origin, and the angular velocity in body axes.
    """
    j = world * DOFS
    robot = RobotView()
    robot.world = world
    robot.pos = base_pos(arrays, world)
    quat = base_quat(arrays, world)
    robot.quat = quat
    robot.lin_vel = base_velocity(arrays, world, quat)
    robot.prev_lin_vel = arrays.prev_lin_vel[world]
    robot.lin_acc = (robot.lin_vel - robot.prev_lin_vel) / arrays.step_dt
    ang = wp.vec3(arrays.joint_qd[j + 3], arrays.joint_qd[j + 4], arrays.joint_qd[j + 5])
    robot.ang_vel = wp.quat_rotate_inv(quat, ang)
    robot.projected_gravity = wp.quat_rotate_inv(quat, wp.vec3(0.0, 0.0, -1.0))
    robot.gravity_magnitude = -arrays.gravity[world][2]
    below = surface(world_ground(ground, world), robot.pos[0], robot.pos[1])
    robot.height = robot.pos[2] - below[0]
    return robot


@wp.func
def of_paws(values: wp.array2d(dtype=float), world: int) -> wp.vec4:
    """Return a world's values of the paws, from an array (4, num_worlds)."""
    return wp.vec4(values[0, world], values[1, world], values[2, world], values[3, world])


@wp.func
def of_motors(values: wp.array2d(dtype=float), world: int) -> vec12:
    """Return a world's values of the motors, from an array (12, num_worlds)."""
    row = vec12()
    for m in range(12):
        row[m] = values[m, world]
    return row


@wp.func
def load_view(arrays: RobotArrays, ground: Ground, world: int) -> RobotView:
    """Return the complete state of a world's robot for rewards, terminations and observations (`RobotView`).

    Members are assigned as a whole: Warp's reverse pass loses an assignment of one component of a struct's vector.
    """
    robot = load_base_view(arrays, ground, world)
    robot.contact_time = of_paws(arrays.contact_time, world)
    robot.air_time = of_paws(arrays.air_time, world)
    robot.touchdown_speed = of_paws(arrays.touchdown_speed, world)
    robot.peak_force = of_paws(arrays.peak_force, world)
    robot.paw_height = of_paws(arrays.paw_height, world)
    contacts = int(0)
    collisions = int(0)
    contact = wp.vec4()
    first_contact = wp.vec4()
    paw_force = wp.vec4()
    paw_pos = mat43()
    paw_vel = mat43()
    for k in range(4):
        down = arrays.contact_time[k, world] > 0.0
        contacts += wp.where(down, 1, 0)
        collisions = collisions | arrays.collisions[k, world]
        contact[k] = wp.where(down, 1.0, 0.0)
        first_contact[k] = wp.where(down and arrays.air_time[k, world] > 0.0, 1.0, 0.0)
        paw_force[k] = wp.length(arrays.paw_force[k, world])
        for j in range(3):
            paw_pos[k, j] = arrays.paw_pos[k, world][j]
            paw_vel[k, j] = arrays.paw_vel[k, world][j]
    robot.contacts = contacts
    robot.collisions = collisions
    robot.contact = contact
    robot.first_contact = first_contact
    robot.paw_force = paw_force
    robot.paw_pos = paw_pos
    robot.paw_vel = paw_vel

    angle = vec12()
    rate = vec12()
    default_angle = vec12()
    clipped = float(0.0)
    for m in range(12):
        slot = motor_slot(m)
        rate[m] = arrays.joint_qd[world * DOFS + 6 + slot]
        angle[m] = arrays.joint_q[world * COORDS + 7 + slot]
        default_angle[m] = arrays.default_angle[m]
        change = arrays.target[m, world] - arrays.filtered_target[m, world]
        clipped += change * change
    robot.angle = angle
    robot.sensed_angle = angle + of_motors(arrays.joint_offset, world)
    robot.rate = rate
    robot.joint_acc = (rate - of_motors(arrays.prev_rate, world)) / arrays.step_dt
    robot.torque = of_motors(arrays.torque, world)
    robot.prev_torque = of_motors(arrays.prev_torque, world)
    robot.action = of_motors(arrays.action, world)
    robot.prev_action = of_motors(arrays.prev_action, world)
    robot.prev_prev_action = of_motors(arrays.prev_prev_action, world)
    robot.clipped = clipped
    robot.default_angle = default_angle
    return robot


@wp.func
def is_finite(robot: RobotView) -> bool:
    """Return whether position, velocity, motor angles and rates of a robot are finite."""
    total = wp.length_sq(robot.pos) + wp.length_sq(robot.lin_vel) + wp.length_sq(robot.ang_vel)
    for m in range(12):
        total += robot.rate[m] * robot.rate[m] + robot.angle[m] * robot.angle[m]  # max() would ignore a NaN
    return wp.isfinite(total)


@wp.func
def has_diverged(robot: RobotView) -> bool:
    """Return whether the simulation of a robot diverged: its state is not finite or too fast.

    Too fast is more than 15 m/s or 40 rad/s of the base, or 120 rad/s of any motor: beyond all that the robot can do.
    """
    fastest = float(0.0)
    for m in range(12):
        fastest = wp.max(fastest, wp.abs(robot.rate[m]))
    too_fast = wp.length(robot.lin_vel) > 15.0 or wp.length(robot.ang_vel) > 40.0 or fastest > 120.0
    return too_fast or not is_finite(robot)


@wp.func
def yaw_of(quat: wp.quat) -> float:
    """Return the yaw [rad] of an orientation (xyzw): the heading of body x in the world plane."""
    ahead = wp.quat_rotate(quat, wp.vec3(1.0, 0.0, 0.0))
    return wp.atan2(ahead[1], ahead[0])


@wp.func
def rotate_yaw(v: wp.vec3, heading: float) -> wp.vec3:
    """Return a vector rotated about z by a heading [rad]: from heading axes to world axes."""
    return wp.quat_rotate(wp.quat_from_axis_angle(wp.vec3(0.0, 0.0, 1.0), heading), v)


@wp.func
def angle_from_level(quat: wp.quat, heading: float) -> float:
    """Return the angle [rad] between an orientation (xyzw) and the level orientation with a yaw `heading` [rad]."""
    half = 0.5 * heading
    level = wp.quat(0.0, 0.0, wp.sin(half), wp.cos(half))
    turn = wp.quat_inverse(level) * quat
    return 2.0 * wp.atan2(wp.length(wp.vec3(turn[0], turn[1], turn[2])), wp.abs(turn[3]))


@wp.func
def in_flight(robot: RobotView, flying: bool, takeoff_speed: float) -> bool:
    """Return whether the robot is in flight after this policy step; flying: the result of the previous step.

    A flight begins when no paw is in contact and the base rises faster than takeoff_speed [m/s], 0.75 in the stock
    jumps: a squat that lifts all paws is no flight. A flight ends when a paw is in contact and the base does not rise
    faster than takeoff_speed. Contact at a higher upward speed belongs to the push-off (compliant contact can break
    during it) or to a clipped edge.
    """
    rises = robot.lin_vel[2] > takeoff_speed
    if robot.contacts == 0 and rises:
        return True
    if robot.contacts > 0 and not rises:
        return False
    return flying


@wp.func
def tilt(robot: RobotView) -> float:
    """Return the angle [rad], 0 to pi, by which the base is tilted: between body z and world z."""
    return wp.acos(wp.clamp(-robot.projected_gravity[2], -1.0, 1.0))


@wp.func
def base_deceleration(robot: RobotView) -> float:
    """Return minus the base's deceleration along its previous velocity [m/s^2]; 0 if it speeds up.

    Plastic contact can stop the base within a step: the velocity before the step, not the one after, has the direction
    of the impact. The value is a mean of the policy step, <= 0. A rebound does not count: the largest loss in a policy
    step is the whole previous speed.
    """
    speed = wp.length(robot.prev_lin_vel)
    if speed < 1.0e-6:
        return 0.0
    new_speed = wp.dot(robot.lin_vel, robot.prev_lin_vel) / speed  # [m/s] along the previous velocity
    rate = wp.dot(robot.lin_acc, robot.prev_lin_vel) / speed
    if new_speed < 0.0:
        rate = rate * speed / (speed - new_speed)
    return wp.min(rate, 0.0)
