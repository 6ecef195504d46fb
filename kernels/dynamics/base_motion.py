"""Rigid motion of the base: integration of its pose, and wrenches moved to its origin.

The equations of motion are about the base link's origin in body axes (x ahead, y left, z up); Newton's wrenches act at
its centre of mass, in world axes. Quaternions are xyzw, body to world.
"""

import warp as wp

from ..scalar import quat, real, vec3
from ..state import BaseState


@wp.struct
class Wrench:
    """External force [N] and moment [N m] about the base origin, body axes."""

    force: vec3
    moment: vec3


@wp.func
def external_wrench(base: BaseState, com: vec3, force_at_com: vec3, moment: vec3) -> Wrench:
    """Return an external wrench, given at the base's com, moved to the base's origin and rotated to body axes.

    force [N], moment [N m]: world axes; com [m]: body frame.
    """
    wrench = Wrench()
    wrench.force = wp.quat_rotate_inv(base.quat, force_at_com)
    wrench.moment = wp.quat_rotate_inv(base.quat, moment) + wp.cross(com, wrench.force)
    return wrench


@wp.func
def exp_rotation(rotation_vector: vec3) -> quat:
    """Return the quaternion (xyzw) of a rotation vector [rad]."""
    half_sq = real(0.25) * wp.dot(rotation_vector, rotation_vector)
    # sin(h)/h and cos(h) to float32 rounding for the turns of one step (h < 0.2)
    sinc = real(1.0) - half_sq / real(6.0) * (real(1.0) - half_sq / real(20.0) * (real(1.0) - half_sq / real(42.0)))
    v = real(0.5) * sinc * rotation_vector
    cosine = real(1.0) - half_sq / real(2.0) * (
        real(1.0) - half_sq / real(12.0) * (real(1.0) - half_sq / real(30.0) * (real(1.0) - half_sq / real(56.0)))
    )
    return wp.normalize(quat(v[0], v[1], v[2], cosine))


@wp.func
def integrate_base(base: BaseState, lin: vec3, ang: vec3, dt: real) -> BaseState:
    """Return the base state integrated over dt [s] with the twist at its end; lin [m/s], ang [rad/s]: old body axes.

    Velocities are updated first and move the pose (semi-implicit Euler). ang keeps its components: they are the same in
    old and new body axes, since the turn is about ang itself.
    """
    moved = BaseState()
    moved.lin = wp.quat_rotate(base.quat, lin)
    moved.ang = ang
    moved.pos = base.pos + dt * moved.lin
    moved.quat = wp.normalize(base.quat * exp_rotation(dt * ang))
    return moved
