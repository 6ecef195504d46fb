"""Completion of a Newton state from the base and the 12 motors: passive knees, loop joints, poses of all bodies.

The solver advances only base and motors, which determine the closed loops; viewers and sensors read Newton's complete
state. Newton closes a leg's loop by a ball joint at the ankle (4 coordinates, 3 rates). Housing axes are body axes (x
ahead, y left, z up) turned about x by the lateral motor; links rotate about housing +y, 0 for one that hangs along -z.
`front`: +1 front leg, -1 back leg; `side`: +1 left, -1 right. Quaternions are xyzw, to the world.
"""

import warp as wp

from ..layout import BODIES, LEG_BODIES
from ..scalar import quat, real, vec2, vec3
from ..state import BaseState, leg_coord, leg_dof, load_base, load_motors
from .five_bar import FiveBarBias, five_bar, five_bar_bias, in_plane
from .geometry import LegGeometry, leg_of

wp.set_module_options({"enable_backward": False})


@wp.struct
class Frame:
    """Pose and velocity of a link frame's origin in the world."""

    pos: vec3  # [m]
    quat: quat  # xyzw
    lin: vec3  # [m/s], of the origin
    ang: vec3  # [rad/s]


@wp.func
def rotation_x(angle: real) -> quat:
    """Return the quaternion (xyzw) of a rotation about x [rad]."""
    return quat(wp.sin(real(0.5) * angle), real(0.0), real(0.0), wp.cos(real(0.5) * angle))


@wp.func
def rotation_y(angle: real) -> quat:
    """Return the quaternion (xyzw) of a rotation about y [rad]."""
    return quat(real(0.0), wp.sin(real(0.5) * angle), real(0.0), wp.cos(real(0.5) * angle))


@wp.func
def shank_angle(direction: vec2) -> real:
    """Return the rotation about housing +y [rad] of a shank, 0 along -z; direction (x, z): unit, knee to ankle."""
    return wp.atan2(-direction[0], -direction[1])


@wp.func
def housing_frame(base: BaseState, geo: LegGeometry, angle: real, rate: real) -> Frame:
    """Return pose and velocity of a leg's motor housing in the world, for lateral angle [rad] and rate [rad/s]."""
    frame = Frame()
    arm = wp.quat_rotate(base.quat, geo.hip)
    ang = wp.quat_rotate(base.quat, base.ang)
    frame.pos = base.pos + arm
    frame.lin = base.lin + wp.cross(ang, arm)
    frame.quat = base.quat * rotation_x(geo.side * angle)
    frame.ang = ang + wp.quat_rotate(base.quat, vec3(geo.side * rate, real(0.0), real(0.0)))
    return frame


@wp.func
def link_frame(housing: Frame, origin: vec3, velocity: vec3, angle: real, rate: real) -> Frame:
    """Return pose and velocity in the world of the frame of a link in the five-bar's plane.

    origin [m], velocity [m/s] of the link's origin in the housing frame; angle [rad], rate [rad/s] about housing y.
    """
    frame = Frame()
    arm = wp.quat_rotate(housing.quat, origin)
    frame.pos = housing.pos + arm
    frame.lin = housing.lin + wp.cross(housing.ang, arm) + wp.quat_rotate(housing.quat, velocity)
    frame.quat = housing.quat * rotation_y(angle)
    frame.ang = housing.ang + wp.quat_rotate(housing.quat, vec3(real(0.0), rate, real(0.0)))
    return frame


@wp.func
def store_body(
    frame: Frame, body: int, body_com: wp.array(dtype=wp.vec3), body_q: wp.array(dtype=wp.transform),
    body_qd: wp.array(dtype=wp.spatial_vector),
):  # fmt: skip
    """Write a body's world pose, and its velocity at the centre of mass; body: index over all worlds.

    Newton stores the pose of a link's origin, but the velocity of its centre of mass, `body_com` [m] in its frame.
    """
    com = body_com[body]
    lin = frame.lin + wp.cross(frame.ang, wp.quat_rotate(frame.quat, vec3(real(com[0]), real(com[1]), real(com[2]))))
    body_q[body] = wp.transform(
        wp.vec3(float(frame.pos[0]), float(frame.pos[1]), float(frame.pos[2])),
        wp.quat(float(frame.quat[0]), float(frame.quat[1]), float(frame.quat[2]), float(frame.quat[3])),
    )
    body_qd[body] = wp.spatial_vector(
        float(lin[0]), float(lin[1]), float(lin[2]), float(frame.ang[0]), float(frame.ang[1]), float(frame.ang[2])
    )


@wp.func
def base_frame(base: BaseState) -> Frame:
    """Return pose and velocity of the base link's frame in the world."""
    frame = Frame()
    frame.pos = base.pos
    frame.quat = base.quat
    frame.lin = base.lin
    frame.ang = wp.quat_rotate(base.quat, base.ang)
    return frame


@wp.func
def store_passive(
    geo: LegGeometry, bias: FiveBarBias, outer: real, inner: real, outer_thigh: real, inner_thigh: real, k: int,
    coord: int, dof: int, joint_q: wp.array(dtype=real), joint_qd: wp.array(dtype=real),
):  # fmt: skip
    """Write the coordinates of the passive knees and of the loop joint of leg k.

    outer, inner, outer_thigh, inner_thigh [rad]: rotations of shanks and thighs about housing +y. coord, dof: indices
    of the leg's first joint in joint_q and joint_qd.
    """
    joint_q[coord + 2] = geo.front * (outer - outer_thigh)
    joint_q[coord + 4] = -geo.front * (inner - inner_thigh)
    joint_qd[dof + 2] = geo.front * (bias.outer_shank_rate - bias.outer_thigh_rate)
    joint_qd[dof + 4] = -geo.front * (bias.inner_shank_rate - bias.inner_thigh_rate)
    across = rotation_y(outer - inner)
    # the loop joints follow the world's 27 tree coordinates (4 each) and 26 tree rates (3 each)
    loop_coord = coord + 20 - k
    loop_dof = dof + 20 - 2 * k
    for i in range(4):
        joint_q[loop_coord + i] = across[i]
    joint_qd[loop_dof] = real(0.0)
    joint_qd[loop_dof + 1] = bias.outer_shank_rate - bias.inner_shank_rate
    joint_qd[loop_dof + 2] = real(0.0)


@wp.kernel
def full_state_kernel(
    # in
    first: int,
    geometry: wp.array(dtype=LegGeometry),
    body_com: wp.array(dtype=wp.vec3),
    # in, out
    joint_q: wp.array(dtype=real),
    joint_qd: wp.array(dtype=real),
    # out
    body_q: wp.array(dtype=wp.transform),
    body_qd: wp.array(dtype=wp.spatial_vector),
):
    """Write the states of knees, loop joints and bodies from base and motor coordinates; one thread per (world, leg).

    first: world of the first thread. Arrays are Newton's, flat over worlds; body_com [m]: in each body's frame.
    """
    world, k = wp.tid()
    world += first
    zero = real(0.0)
    geo = leg_of(geometry, world, k)
    com = body_com[world * BODIES]
    base = load_base(joint_q, joint_qd, vec3(real(com[0]), real(com[1]), real(com[2])), world)
    coord = leg_coord(world, k)
    dof = leg_dof(world, k)
    angles = load_motors(joint_q, coord)
    rates = load_motors(joint_qd, dof)
    loop = five_bar(geo, angles[1], angles[2])
    bias = five_bar_bias(geo, loop, rates[1], rates[2])
    outer = shank_angle(loop.outer_shank)
    inner = shank_angle(loop.inner_shank)
    outer_thigh = -geo.front * angles[1]
    inner_thigh = geo.front * angles[2]
    store_passive(geo, bias, outer, inner, outer_thigh, inner_thigh, k, coord, dof, joint_q, joint_qd)
    if k == 0:
        store_body(base_frame(base), world * BODIES, body_com, body_q, body_qd)
    y = geo.plane_y + geo.knee_y
    outer_axis = vec3(geo.outer_x, geo.plane_y, zero)
    inner_axis = vec3(geo.inner_x, geo.plane_y, zero)
    outer_vel = in_plane(rates[1] * loop.outer_knee_do, zero)
    inner_vel = in_plane(rates[2] * loop.inner_knee_di, zero)
    body = world * BODIES + 1 + LEG_BODIES * k
    housing = housing_frame(base, geo, angles[0], rates[0])
    f1 = link_frame(housing, outer_axis, vec3(zero), outer_thigh, bias.outer_thigh_rate)
    f2 = link_frame(housing, in_plane(loop.outer_knee, y), outer_vel, outer, bias.outer_shank_rate)
    f3 = link_frame(housing, inner_axis, vec3(zero), inner_thigh, bias.inner_thigh_rate)
    f4 = link_frame(housing, in_plane(loop.inner_knee, y), inner_vel, inner, bias.inner_shank_rate)
    store_body(housing, body, body_com, body_q, body_qd)
    store_body(f1, body + 1, body_com, body_q, body_qd)
    store_body(f2, body + 2, body_com, body_q, body_qd)
    store_body(f3, body + 3, body_com, body_q, body_qd)
    store_body(f4, body + 4, body_com, body_q, body_qd)
