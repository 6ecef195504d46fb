"""Reading and writing the robot's 18 coordinates in Newton's state arrays.

Per world `joint_q` holds 43 coordinates: base position, base quaternion (xyzw), five angles a leg (lateral, outer,
outer knee, inner, inner knee), and four loop-joint quaternions. `joint_qd` holds 38 rates in the same order. The base's
rates are the velocity of its centre of mass and its angular velocity, both in the world frame. The physics kernels use
the velocity of the base's origin and body axes instead, in which a leg's terms do not depend on the pose. The closed
loops leave 18 of the coordinates free: 6 of the base and 12 of the motors; `full_state` completes the others.
"""

import warp as wp

from .layout import BASE, COORDS, DOFS
from .scalar import quat, real, vec3


@wp.struct
class BaseState:
    """Pose of the base link, velocity of its origin (world axes), and angular velocity (body axes)."""

    pos: vec3  # [m], world
    quat: quat  # xyzw, body to world
    lin: vec3  # [m/s], of the origin, world
    ang: vec3  # [rad/s], body axes


@wp.func
def base_com(table: wp.array2d(dtype=real), world: int) -> vec3:
    """Return the base link's centre of mass [m] in its frame; table: (PARAMETER_ROWS, num_worlds), see `layout`."""
    return vec3(table[BASE + 1, world], table[BASE + 2, world], table[BASE + 3, world]) / table[BASE, world]


@wp.func
def load_base(joint_q: wp.array(dtype=real), joint_qd: wp.array(dtype=real), com: vec3, world: int) -> BaseState:
    """Return the base state of a world; com [m]: the base link's centre of mass in its frame."""
    i = world * COORDS
    j = world * DOFS
    base = BaseState()
    base.pos = vec3(joint_q[i], joint_q[i + 1], joint_q[i + 2])
    base.quat = wp.normalize(quat(joint_q[i + 3], joint_q[i + 4], joint_q[i + 5], joint_q[i + 6]))
    ang = vec3(joint_qd[j + 3], joint_qd[j + 4], joint_qd[j + 5])
    com_lin = vec3(joint_qd[j], joint_qd[j + 1], joint_qd[j + 2])
    base.lin = com_lin - wp.cross(ang, wp.quat_rotate(base.quat, com))
    base.ang = wp.quat_rotate_inv(base.quat, ang)
    return base


@wp.func
def store_base(joint_q: wp.array(dtype=real), joint_qd: wp.array(dtype=real), com: vec3, world: int, base: BaseState):
    """Write the base state of a world to Newton's arrays: the inverse of `load_base`, with the same arguments."""
    i = world * COORDS
    j = world * DOFS
    ang = wp.quat_rotate(base.quat, base.ang)
    lin = base.lin + wp.cross(ang, wp.quat_rotate(base.quat, com))
    for c in range(3):
        joint_q[i + c] = base.pos[c]
        joint_qd[j + c] = lin[c]
        joint_qd[j + 3 + c] = ang[c]
    for c in range(4):
        joint_q[i + 3 + c] = base.quat[c]


@wp.func
def load_motors(values: wp.array(dtype=real), first: int) -> vec3:
    """Return a leg's motor values (lateral, outer, inner) out of its five joint values, which begin at `first`."""
    return vec3(values[first], values[first + 1], values[first + 3])


@wp.func
def store_motors(values: wp.array(dtype=real), first: int, motors: vec3):
    """Write a leg's motor values (lateral, outer, inner) to its joint values, which begin at `first`, except knees."""
    values[first] = motors[0]
    values[first + 1] = motors[1]
    values[first + 3] = motors[2]


@wp.func
def leg_coord(world: int, leg: int) -> int:
    """Return the index in joint_q of the first joint of a leg (0 to 3) of a world."""
    return world * COORDS + 7 + 5 * leg


@wp.func
def leg_dof(world: int, leg: int) -> int:
    """Return the index in joint_qd of the first joint of a leg (0 to 3) of a world."""
    return world * DOFS + 6 + 5 * leg
