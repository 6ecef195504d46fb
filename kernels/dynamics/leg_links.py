"""Sums over the moving links of one leg, in the motor housing frame.

Each sum is an integral over the mass of a link of products of position r (about the hip) and its derivatives
r_o, r_i with respect to the outer and inner motor angle. From them follow the leg's kinetic energy and, with
Lagrange's equations, every inertial coupling and velocity-product force (`leg_dynamics`).
"""

import warp as wp

from ..kinematics.five_bar import FiveBar, FiveBarBias, in_plane
from ..kinematics.geometry import LegGeometry
from ..scalar import real, vec2, vec3, vec6
from .inertia import MassMoments, rotate_y, rotate_y_second, sym_outer


@wp.struct
class LinkSums:
    """Integrals over link mass; subscripts o and i mean derivatives by the outer and inner motor angle."""

    mass: real  # of 1
    first: vec3  # of r
    second: vec6  # of r r^T
    second_o: vec6  # of r_o r^T + r r_o^T
    second_i: vec6
    lin_o: vec3  # of r_o: linear momentum per motor rate
    lin_i: vec3
    ang_o: vec3  # of r x r_o: angular momentum about the hip per motor rate
    ang_i: vec3
    inertia_oo: real  # of r_o . r_o
    inertia_oi: real
    inertia_ii: real
    coriolis: real  # y component of 2 r_i x r_o
    lin_acc: vec3  # of the acceleration while motor accelerations are zero
    ang_acc: vec3  # of r x that acceleration
    bias_o: real  # of r_o . that acceleration
    bias_i: real


@wp.func
def add_sums(a: LinkSums, b: LinkSums) -> LinkSums:
    """Return the sums over both mass distributions."""
    c = LinkSums()
    c.mass = a.mass + b.mass
    c.first = a.first + b.first
    c.second = a.second + b.second
    c.second_o = a.second_o + b.second_o
    c.second_i = a.second_i + b.second_i
    c.lin_o = a.lin_o + b.lin_o
    c.lin_i = a.lin_i + b.lin_i
    c.ang_o = a.ang_o + b.ang_o
    c.ang_i = a.ang_i + b.ang_i
    c.inertia_oo = a.inertia_oo + b.inertia_oo
    c.inertia_oi = a.inertia_oi + b.inertia_oi
    c.inertia_ii = a.inertia_ii + b.inertia_ii
    c.coriolis = a.coriolis + b.coriolis
    c.lin_acc = a.lin_acc + b.lin_acc
    c.ang_acc = a.ang_acc + b.ang_acc
    c.bias_o = a.bias_o + b.bias_o
    c.bias_i = a.bias_i + b.bias_i
    return c


@wp.func
def turn_y(v: vec3) -> vec3:
    """Return e_y x v."""
    return vec3(v[2], real(0.0), -v[0])


@wp.func
def turn_y_second(s: vec6) -> vec6:
    """Return the derivative of packed second moments by a rotation about y."""
    two = real(2.0)
    return vec6(two * s[4], real(0.0), -two * s[4], s[5], s[2] - s[0], -s[3])


@wp.func
def spin_y(s: vec6) -> vec3:
    """Return the integral of r x (e_y x r): angular momentum of a unit rotation rate about y."""
    return vec3(-s[3], s[0] + s[2], -s[5])


@wp.func
def shank_sums(
    link: MassMoments,
    knee: vec3,
    direction: vec2,
    knee_do: vec3,
    knee_di: vec3,
    turn_do: real,
    turn_di: real,
    rate: real,
    knee_acc: vec3,
    turn_acc: real,
) -> LinkSums:
    """Return the sums of a shank whose frame sits at the knee and turns about y."""
    # a shank hanging along -z has direction (0, -1): its rotation has sine -x and cosine -z
    u = rotate_y(link.first, -direction[1], -direction[0])
    s = rotate_y_second(link.second, -direction[1], -direction[0])
    first = link.mass * knee + u
    spin = spin_y(s)
    u_turned = turn_y(u)
    s_turned = turn_y_second(s)
    u_o = turn_do * u_turned
    u_i = turn_di * u_turned
    planar = s[0] + s[2]
    u_acc = turn_acc * u_turned - rate * rate * vec3(u[0], real(0.0), u[2])

    sums = LinkSums()
    sums.mass = link.mass
    sums.first = first
    sums.second = real(0.5) * link.mass * sym_outer(knee, knee) + sym_outer(knee, u) + s
    sums.second_o = sym_outer(knee_do, first) + sym_outer(u_o, knee) + turn_do * s_turned
    sums.second_i = sym_outer(knee_di, first) + sym_outer(u_i, knee) + turn_di * s_turned
    sums.lin_o = link.mass * knee_do + u_o
    sums.lin_i = link.mass * knee_di + u_i
    sums.ang_o = wp.cross(first, knee_do) + wp.cross(knee, u_o) + turn_do * spin
    sums.ang_i = wp.cross(first, knee_di) + wp.cross(knee, u_i) + turn_di * spin
    sums.inertia_oo = wp.dot(knee_do, sums.lin_o) + wp.dot(knee_do, u_o) + turn_do * turn_do * planar
    sums.inertia_oi = wp.dot(knee_do, sums.lin_i) + wp.dot(knee_di, u_o) + turn_do * turn_di * planar
    sums.inertia_ii = wp.dot(knee_di, sums.lin_i) + wp.dot(knee_di, u_i) + turn_di * turn_di * planar
    across = wp.cross(sums.lin_i, knee_do) + wp.cross(knee_di, u_o)
    sums.coriolis = real(2.0) * across[1]
    sums.lin_acc = link.mass * knee_acc + u_acc
    sums.ang_acc = (
        wp.cross(first, knee_acc) + wp.cross(knee, u_acc) + turn_acc * spin - rate * rate * vec3(s[5], real(0.0), -s[3])
    )
    sums.bias_o = wp.dot(knee_do, sums.lin_acc) + wp.dot(u_o, knee_acc) + turn_do * turn_acc * planar
    sums.bias_i = wp.dot(knee_di, sums.lin_acc) + wp.dot(u_i, knee_acc) + turn_di * turn_acc * planar
    return sums


@wp.func
def thigh_sums(link: MassMoments, axis: vec3, cosine: real, sine: real, rate: real, turn: real) -> LinkSums:
    """Return the sums of a thigh that turns about its fixed transversal axis by `turn` (-1 or +1) per motor angle.

    The derivatives by its own motor are put into the `o` fields; `as_inner` moves them.
    """
    u = rotate_y(link.first, cosine, sine)
    s = rotate_y_second(link.second, cosine, sine)
    u_own = turn * turn_y(u)
    u_acc = -rate * rate * vec3(u[0], real(0.0), u[2])

    sums = LinkSums()
    sums.mass = link.mass
    sums.first = link.mass * axis + u
    sums.second = real(0.5) * link.mass * sym_outer(axis, axis) + sym_outer(axis, u) + s
    sums.second_o = sym_outer(u_own, axis) + turn * turn_y_second(s)
    sums.lin_o = u_own
    sums.ang_o = wp.cross(axis, u_own) + turn * spin_y(s)
    sums.inertia_oo = s[0] + s[2]
    sums.lin_acc = u_acc
    sums.ang_acc = wp.cross(axis, u_acc) - rate * rate * vec3(s[5], real(0.0), -s[3])
    return sums


@wp.func
def as_inner(a: LinkSums) -> LinkSums:
    """Return a thigh's sums with the derivatives of its own motor in the inner fields."""
    b = LinkSums()
    b.mass = a.mass
    b.first = a.first
    b.second = a.second
    b.second_i = a.second_o
    b.lin_i = a.lin_o
    b.ang_i = a.ang_o
    b.inertia_ii = a.inertia_oo
    b.lin_acc = a.lin_acc
    b.ang_acc = a.ang_acc
    return b


@wp.func
def outer_sums(
    geo: LegGeometry, thigh: MassMoments, shank: MassMoments, loop: FiveBar, bias: FiveBarBias, angle: real
) -> LinkSums:
    """Return the sums of the outer thigh and shank."""
    zero = real(0.0)
    axis = vec3(geo.outer_x, geo.plane_y, zero)
    thigh_part = thigh_sums(thigh, axis, wp.cos(angle), -geo.front * wp.sin(angle), bias.outer_thigh_rate, -geo.front)
    shank_part = shank_sums(
        shank,
        in_plane(loop.outer_knee, geo.plane_y + geo.knee_y),
        loop.outer_shank,
        in_plane(loop.outer_knee_do, zero),
        vec3(zero),
        loop.outer_shank_do,
        loop.outer_shank_di,
        bias.outer_shank_rate,
        in_plane(bias.outer_knee_acc, zero),
        bias.outer_shank_acc,
    )
    return add_sums(thigh_part, shank_part)


@wp.func
def inner_sums(
    geo: LegGeometry, thigh: MassMoments, shank: MassMoments, loop: FiveBar, bias: FiveBarBias, angle: real
) -> LinkSums:
    """Return the sums of the inner thigh and shank."""
    zero = real(0.0)
    axis = vec3(geo.inner_x, geo.plane_y, zero)
    thigh_part = thigh_sums(thigh, axis, wp.cos(angle), geo.front * wp.sin(angle), bias.inner_thigh_rate, geo.front)
    shank_part = shank_sums(
        shank,
        in_plane(loop.inner_knee, geo.plane_y + geo.knee_y),
        loop.inner_shank,
        vec3(zero),
        in_plane(loop.inner_knee_di, zero),
        loop.inner_shank_do,
        loop.inner_shank_di,
        bias.inner_shank_rate,
        in_plane(bias.inner_knee_acc, zero),
        bias.inner_shank_acc,
    )
    return add_sums(as_inner(thigh_part), shank_part)
