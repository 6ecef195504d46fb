"""Mass integrals over the moving links of one leg, in the motor housing frame.

Each sum is an integral over the mass of a link of products of position r (about the hip) and its derivatives
r_o, r_i with respect to the outer and inner motor angle. From them follow the leg's kinetic energy and, with
Lagrange's equations, every inertial coupling and velocity-product force (`leg_dynamics`).

The links move in the five-bar's plane, so derivatives of r and accelerations have no y: they are stored as (x, z).
Housing axes are body axes (x ahead, y left, z up) turned about x by the lateral motor. Links rotate about housing +y, 0
for a link that hangs along -z. A positive motor angle moves a thigh away from the other one: with `front` +1 for a
front leg and -1 for a back leg, it turns an outer thigh by -front * angle, an inner one by front * angle. `link.first`
and `link.second` are in the link's own frame; u and s are the same moments in housing axes.
"""

import warp as wp

from ..kinematics.five_bar import FiveBar, FiveBarBias
from ..kinematics.geometry import LegGeometry
from ..scalar import real, vec2, vec3, vec5, vec6
from .inertia import MassMoments, rotate_y, rotate_y_second, sym_outer


@wp.struct
class LinkSums:
    """Integrals over the mass of moving links of a leg, which give its inertia, couplings to the base and bias forces.

    Subscripts o and i: derivatives w.r.t. the outer and inner motor angle. In the sums of one side of the leg, o is the
    motor of that side and i the other motor; `leg_sums` reorders them.
    """

    mass: real  # [kg]
    first: vec3  # [kg m] of r
    second: vec6  # [kg m^2] of r r^T: xx yy zz xy xz yz
    second_o: vec5  # of r_o r^T + r r_o^T: xx zz xy xz yz
    second_i: vec5
    lin_o: vec2  # [kg m] of r_o: linear momentum per motor rate
    lin_i: vec2
    ang_o: vec3  # [kg m^2] of r x r_o: angular momentum about the hip per motor rate
    ang_i: vec3
    inertia_oo: real  # [kg m^2] of r_o . r_o
    inertia_oi: real
    inertia_ii: real
    coriolis: real  # [kg m^2] y component of 2 r_i x r_o
    lin_acc: vec2  # [N] of the acceleration while motor accelerations are zero
    ang_acc: vec3  # [N m] of r x that acceleration
    bias_o: real  # [N m] of r_o . that acceleration
    bias_i: real


@wp.func
def cross_y(v: vec3) -> vec2:
    """Return the cross product of the unit vector along y and v, as (x, z)."""
    return vec2(v[2], -v[0])


@wp.func
def cross_y_second(s: vec6) -> vec5:
    """Return the derivative of packed second moments w.r.t. their rotation angle about +y, without its yy, which is 0.

    Order: xx zz xy xz yz.
    """
    two = real(2.0)
    return vec5(two * s[4], -two * s[4], s[5], s[2] - s[0], -s[3])


@wp.func
def spin_y(s: vec6) -> vec3:
    """Return the angular momentum per unit rate [kg m^2] of masses that rotate about +y, from second moments s.

    The result is the integral of r x (e_y x r).
    """
    return vec3(-s[3], s[0] + s[2], -s[5])


@wp.func
def cross_plane(a: vec3, b: vec2) -> vec3:
    """Return the cross product of a vector a and a vector of the xz plane: a x (b[0], 0, b[1])."""
    return vec3(a[1] * b[1], a[2] * b[0] - a[0] * b[1], -a[1] * b[0])


@wp.func
def sym_outer_plane(a: vec2, b: vec3) -> vec5:
    """Return a b^T + b a^T for a vector a = (x, z) of the plane and a vector b, packed without yy: xx zz xy xz yz."""
    two = real(2.0)
    return vec5(two * a[0] * b[0], two * a[1] * b[2], a[0] * b[1], a[0] * b[2] + a[1] * b[0], a[1] * b[1])


@wp.func
def shank_sums(
    link: MassMoments,
    knee: vec3,
    direction: vec2,
    knee_do: vec2,
    rotation_do: real,
    rotation_di: real,
    rate: real,
    knee_acc: vec2,
    rotation_acc: real,
) -> LinkSums:
    """Return the mass integrals of a shank, whose frame has its origin at its knee and rotates about housing +y.

    link: moments in that frame. knee [m], direction (unit, knee to ankle): in the housing frame. Derivatives: knee_do
    [m/rad] by the motor of the shank's side; rotation_do, rotation_di [1] of the shank's angle by that motor and by
    the other. rate [rad/s], knee_acc [m/s^2], rotation_acc [rad/s^2]: see `FiveBarBias`.
    """
    # a shank hanging along -z has direction (0, -1): its rotation has sine -x and cosine -z
    u = rotate_y(link.first, -direction[1], -direction[0])
    s = rotate_y_second(link.second, -direction[1], -direction[0])
    first = link.mass * knee + u
    spin = spin_y(s)
    u_by_angle = cross_y(u)
    s_by_angle = cross_y_second(s)
    u_o = rotation_do * u_by_angle
    u_i = rotation_di * u_by_angle
    planar = s[0] + s[2]
    u_acc = rotation_acc * u_by_angle - rate * rate * vec2(u[0], u[2])

    sums = LinkSums()
    sums.mass = link.mass
    sums.first = first
    sums.second = real(0.5) * link.mass * sym_outer(knee, knee) + sym_outer(knee, u) + s
    sums.second_o = sym_outer_plane(knee_do, first) + sym_outer_plane(u_o, knee) + rotation_do * s_by_angle
    sums.second_i = sym_outer_plane(u_i, knee) + rotation_di * s_by_angle
    sums.lin_o = link.mass * knee_do + u_o
    sums.lin_i = u_i
    sums.ang_o = cross_plane(first, knee_do) + cross_plane(knee, u_o) + rotation_do * spin
    sums.ang_i = cross_plane(knee, u_i) + rotation_di * spin
    sums.inertia_oo = wp.dot(knee_do, sums.lin_o) + wp.dot(knee_do, u_o) + rotation_do * rotation_do * planar
    sums.inertia_oi = wp.dot(knee_do, u_i) + rotation_do * rotation_di * planar
    sums.inertia_ii = rotation_di * rotation_di * planar
    sums.coriolis = real(2.0) * (u_i[1] * knee_do[0] - u_i[0] * knee_do[1])
    sums.lin_acc = link.mass * knee_acc + u_acc
    sums.ang_acc = (
        cross_plane(first, knee_acc)
        + cross_plane(knee, u_acc)
        + rotation_acc * spin
        - rate * rate * vec3(s[5], real(0.0), -s[3])
    )
    sums.bias_o = wp.dot(knee_do, sums.lin_acc) + wp.dot(u_o, knee_acc) + rotation_do * rotation_acc * planar
    sums.bias_i = wp.dot(u_i, knee_acc) + rotation_di * rotation_acc * planar
    return sums


@wp.func
def add_thigh(
    shank: LinkSums, link: MassMoments, axis: vec2, cosine: real, sine: real, rate: real, sign: real
) -> LinkSums:
    """Add the mass integrals of a thigh to the integrals of its shank; link: moments of the thigh in its frame.

    The thigh rotates about its transversal axis, at x and y `axis` [m], z = 0 in the housing frame, by `sign` (-1 or
    +1) times its motor's angle; cosine, sine and rate [rad/s] of this rotation about +y.
    """
    u = rotate_y(link.first, cosine, sine)
    s = rotate_y_second(link.second, cosine, sine)
    x, y = axis[0], axis[1]
    u_o = sign * cross_y(u)
    u_acc = -rate * rate * vec2(u[0], u[2])
    two = real(2.0)
    along_x = two * u[0] + link.mass * x

    sums = shank
    sums.mass += link.mass
    sums.first += vec3(link.mass * x + u[0], link.mass * y + u[1], u[2])
    sums.second += (
        vec6(
            x * along_x, y * (two * u[1] + link.mass * y), real(0.0),
            x * u[1] + y * u[0] + link.mass * x * y, x * u[2], y * u[2],
        )
        + s
    )  # fmt: skip
    sums.second_o += vec5(two * u_o[0] * x, real(0.0), u_o[0] * y, u_o[1] * x, u_o[1] * y) + sign * cross_y_second(s)
    sums.lin_o += u_o
    sums.ang_o += vec3(y * u_o[1], -x * u_o[1], -y * u_o[0]) + sign * spin_y(s)
    sums.inertia_oo += s[0] + s[2]
    sums.lin_acc += u_acc
    sums.ang_acc += vec3(y * u_acc[1] - rate * rate * s[5], -x * u_acc[1], rate * rate * s[3] - y * u_acc[0])
    return sums


@wp.func
def outer_sums(geo: LegGeometry, thigh: MassMoments, shank: MassMoments, loop: FiveBar, bias: FiveBarBias) -> LinkSums:
    """Return the mass integrals of outer thigh and shank together; subscripts: o is the outer motor, i the inner.

    The outer motor moves both; the inner one moves only the shank, through the ankle of the closed loop.
    """
    sin_cos = loop.outer_sin_cos
    knee = vec3(loop.outer_knee[0], geo.plane_y + geo.knee_y, loop.outer_knee[1])
    shank_part = shank_sums(
        shank, knee, loop.outer_shank, loop.outer_knee_do, loop.outer_shank_do, loop.outer_shank_di,
        bias.outer_shank_rate, bias.outer_knee_acc, bias.outer_shank_acc,
    )  # fmt: skip
    axis = vec2(geo.outer_x, geo.plane_y)
    return add_thigh(shank_part, thigh, axis, sin_cos[1], -geo.front * sin_cos[0], bias.outer_thigh_rate, -geo.front)


@wp.func
def inner_sums(geo: LegGeometry, thigh: MassMoments, shank: MassMoments, loop: FiveBar, bias: FiveBarBias) -> LinkSums:
    """Return the mass integrals of inner thigh and shank together; subscripts: o is the inner motor, i the outer.

    The inner motor moves both; the outer one moves only the shank, through the ankle of the closed loop.
    """
    sin_cos = loop.inner_sin_cos
    knee = vec3(loop.inner_knee[0], geo.plane_y + geo.knee_y, loop.inner_knee[1])
    shank_part = shank_sums(
        shank, knee, loop.inner_shank, loop.inner_knee_di, loop.inner_shank_di, loop.inner_shank_do,
        bias.inner_shank_rate, bias.inner_knee_acc, bias.inner_shank_acc,
    )  # fmt: skip
    axis = vec2(geo.inner_x, geo.plane_y)
    return add_thigh(shank_part, thigh, axis, sin_cos[1], geo.front * sin_cos[0], bias.inner_thigh_rate, geo.front)


@wp.func
def leg_sums(housing: MassMoments, outer: LinkSums, inner: LinkSums) -> LinkSums:
    """Return the mass integrals of a whole leg; subscripts: o is the outer motor, i the inner.

    The housing, at rest in its own frame, has only mass and moments. In `inner`, o and i are swapped (`LinkSums`), so
    its Coriolis term has the opposite sign.
    """
    c = LinkSums()
    c.mass = housing.mass + outer.mass + inner.mass
    c.first = housing.first + outer.first + inner.first
    c.second = housing.second + outer.second + inner.second
    c.second_o = outer.second_o + inner.second_i
    c.second_i = outer.second_i + inner.second_o
    c.lin_o = outer.lin_o + inner.lin_i
    c.lin_i = outer.lin_i + inner.lin_o
    c.ang_o = outer.ang_o + inner.ang_i
    c.ang_i = outer.ang_i + inner.ang_o
    c.inertia_oo = outer.inertia_oo + inner.inertia_ii
    c.inertia_oi = outer.inertia_oi + inner.inertia_oi
    c.inertia_ii = outer.inertia_ii + inner.inertia_oo
    c.coriolis = outer.coriolis - inner.coriolis
    c.lin_acc = outer.lin_acc + inner.lin_acc
    c.ang_acc = outer.ang_acc + inner.ang_acc
    c.bias_o = outer.bias_o + inner.bias_i
    c.bias_i = outer.bias_i + inner.bias_o
    return c
