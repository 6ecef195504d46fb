"""Dynamics of one leg seen from the base: couplings, velocity-product forces, and the leg's elimination.

With the base acceleration a (of the base origin, inertial) and alpha, and motor accelerations q'':

    D q'' + Bv^T a + Bw^T alpha + h = tau
    force on the base origin  = m a - first x alpha + Bv q'' + F
    moment about it           = first x a + I alpha + Bw q'' + N

All vectors are in body axes, about the base origin.
"""

import warp as wp

from ..kinematics.five_bar import FiveBar, five_bar, five_bar_bias, in_plane
from ..kinematics.geometry import LegGeometry
from ..scalar import mat33, real, vec3, vec6
from .inertia import (
    MassMoments,
    inertia_mul,
    mul,
    rotate_x,
    rotate_x_second,
    sym_outer,
    trace,
)
from .leg_links import LinkSums, add_sums, inner_sums, outer_sums


@wp.struct
class LegMasses:
    """Mass moments of the leg's links, each about its own link frame."""

    housing: MassMoments
    outer_thigh: MassMoments
    outer_shank: MassMoments
    inner_thigh: MassMoments
    inner_shank: MassMoments


@wp.struct
class LegDynamics:
    """Inertial couplings and bias forces of one leg; columns of Bv, Bw and D are lateral, outer, inner."""

    body: MassMoments  # of the whole leg about the base origin
    coupling_lin: mat33  # Bv: linear momentum per motor rate [kg m]
    coupling_ang: mat33  # Bw: angular momentum about the base origin per motor rate [kg m^2]
    inertia: mat33  # D: motor-space inertia of the links [kg m^2]
    bias_force: vec3  # F [N], gravity included
    bias_moment: vec3  # N [N m]
    bias_torque: vec3  # h [N m]


@wp.struct
class PawKinematics:
    """Position and velocity maps of the paw centre (the ankle), body axes."""

    position: vec3  # [m] from the base origin
    jacobian: mat33  # [m/rad] d position / d (lateral, outer, inner)
    spin: mat33  # [1] angular velocity of the paw per motor rate


@wp.func
def columns(a: vec3, b: vec3, c: vec3) -> mat33:
    """Return the matrix with columns a, b, c."""
    return mat33(a[0], b[0], c[0], a[1], b[1], c[1], a[2], b[2], c[2])


@wp.func
def paw_kinematics(geo: LegGeometry, loop: FiveBar, cosine: real, sine: real) -> PawKinematics:
    """Return the paw's position and maps; cosine and sine are those of the housing's rotation about body x."""
    zero = real(0.0)
    ankle = in_plane(loop.ankle, geo.plane_y + geo.knee_y)
    paw = PawKinematics()
    paw.position = geo.hip + rotate_x(ankle, cosine, sine)
    paw.jacobian = columns(
        rotate_x(vec3(zero, -geo.side * ankle[2], geo.side * ankle[1]), cosine, sine),
        rotate_x(in_plane(loop.ankle_do, zero), cosine, sine),
        rotate_x(in_plane(loop.ankle_di, zero), cosine, sine),
    )
    pitch = rotate_x(vec3(zero, real(1.0), zero), cosine, sine)
    paw.spin = columns(vec3(geo.side, zero, zero), loop.inner_shank_do * pitch, loop.inner_shank_di * pitch)
    return paw


@wp.func
def housing_sums(housing: MassMoments) -> LinkSums:
    """Return the sums of the housing, which does not move in its own frame."""
    sums = LinkSums()
    sums.mass = housing.mass
    sums.first = housing.first
    sums.second = housing.second
    return sums


@wp.func
def centrifugal(second_j: vec6, w: vec3) -> real:
    """Return 1/2 w^T (dI/dq_j) w, the centrifugal force on motor j [N m]."""
    return real(0.5) * (trace(second_j) * wp.dot(w, w) - wp.dot(w, mul(second_j, w)))


@wp.func
def assemble_leg(
    geo: LegGeometry, sums: LinkSums, cosine: real, sine: real, rates: vec3, omega: vec3, g: vec3
) -> LegDynamics:
    """Return the leg's dynamics from its link sums.

    rates: motor rates [rad/s]; omega: base angular velocity [rad/s], g: gravity [m/s^2], both in body axes.
    """
    zero = real(0.0)
    lateral_rate = geo.side * rates[0]
    lateral_axis = vec3(geo.side, zero, zero)
    omega_m = rotate_x(omega, cosine, -sine)  # of the base, in housing axes
    w = omega_m + vec3(lateral_rate, zero, zero)  # of the housing
    w_acc = vec3(zero, omega_m[2] * lateral_rate, -omega_m[1] * lateral_rate)
    hip_acc = rotate_x(wp.cross(omega, wp.cross(omega, geo.hip)) - g, cosine, -sine)

    lin_rel = rates[1] * sums.lin_o + rates[2] * sums.lin_i
    ang_rel = rates[1] * sums.ang_o + rates[2] * sums.ang_i
    second_rate = rates[1] * sums.second_o + rates[2] * sums.second_i
    w_first = wp.cross(w, sums.first)
    force = (
        sums.mass * hip_acc + wp.cross(w_acc, sums.first) + wp.cross(w, w_first + real(2.0) * lin_rel) + sums.lin_acc
    )
    moment = (
        wp.cross(sums.first, hip_acc)
        + inertia_mul(sums.second, w_acc)
        + wp.cross(w, inertia_mul(sums.second, w) + ang_rel)
        + inertia_mul(second_rate, w)
        + sums.ang_acc
    )
    swirl = w[1] * sums.coriolis
    lateral_ang = inertia_mul(sums.second, lateral_axis)
    lateral_lin = wp.cross(lateral_axis, sums.first)

    leg = LegDynamics()
    leg.bias_torque = vec3(
        geo.side * moment[0],
        wp.dot(sums.lin_o, hip_acc)
        + wp.dot(sums.ang_o, w_acc)
        - centrifugal(sums.second_o, w)
        + swirl * rates[2]
        + sums.bias_o,
        wp.dot(sums.lin_i, hip_acc)
        + wp.dot(sums.ang_i, w_acc)
        - centrifugal(sums.second_i, w)
        - swirl * rates[1]
        + sums.bias_i,
    )
    lo = geo.side * sums.ang_o[0]
    li = geo.side * sums.ang_i[0]
    leg.inertia = mat33(
        geo.side * lateral_ang[0], lo, li, lo, sums.inertia_oo, sums.inertia_oi, li, sums.inertia_oi, sums.inertia_ii
    )
    # to body axes, about the base origin
    lin_l = rotate_x(lateral_lin, cosine, sine)
    lin_o = rotate_x(sums.lin_o, cosine, sine)
    lin_i = rotate_x(sums.lin_i, cosine, sine)
    leg.coupling_lin = columns(lin_l, lin_o, lin_i)
    leg.coupling_ang = columns(
        rotate_x(lateral_ang, cosine, sine) + wp.cross(geo.hip, lin_l),
        rotate_x(sums.ang_o, cosine, sine) + wp.cross(geo.hip, lin_o),
        rotate_x(sums.ang_i, cosine, sine) + wp.cross(geo.hip, lin_i),
    )
    leg.bias_force = rotate_x(force, cosine, sine)
    leg.bias_moment = rotate_x(moment, cosine, sine) + wp.cross(geo.hip, leg.bias_force)
    first = rotate_x(sums.first, cosine, sine)
    body = MassMoments()
    body.mass = sums.mass
    body.first = first + sums.mass * geo.hip
    body.second = (
        rotate_x_second(sums.second, cosine, sine)
        + sym_outer(geo.hip, first)
        + real(0.5) * sums.mass * sym_outer(geo.hip, geo.hip)
    )
    leg.body = body
    return leg


@wp.func
def leg_dynamics(
    geo: LegGeometry, masses: LegMasses, loop: FiveBar, angles: vec3, rates: vec3, omega: vec3, g: vec3
) -> LegDynamics:
    """Return the dynamics of one leg.

    angles, rates: of the lateral, outer and inner motor [rad], [rad/s]; omega: base angular velocity [rad/s];
    g: gravity [m/s^2]; both in body axes.
    """
    bias = five_bar_bias(geo, loop, rates[1], rates[2])
    sums = add_sums(
        add_sums(
            housing_sums(masses.housing),
            outer_sums(geo, masses.outer_thigh, masses.outer_shank, loop, bias, angles[1]),
        ),
        inner_sums(geo, masses.inner_thigh, masses.inner_shank, loop, bias, angles[2]),
    )
    return assemble_leg(geo, sums, wp.cos(angles[0]), geo.side * wp.sin(angles[0]), rates, omega, g)


@wp.func
def leg_five_bar(geo: LegGeometry, angles: vec3) -> FiveBar:
    """Return the five-bar configuration for the three motor angles of a leg [rad]."""
    return five_bar(geo, angles[1], angles[2])
