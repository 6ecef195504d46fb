"""Terms of one leg in the equations of motion: inertia, couplings to the base, and bias (velocity, gravity) forces.

With the linear acceleration a of the base's origin, its angular acceleration alpha, motor accelerations q'' and torques
tau:

    D q'' + Bv^T a + Bw^T alpha + h = tau
    force on the base origin  = m a - first x alpha + Bv q'' + F
    moment about it           = first x a + I alpha + Bw q'' + N

All vectors are in body axes, about the base origin; m, first, I: the leg's mass moments and inertia tensor. Motors are
lateral, outer, inner; the housing turns by side * lateral about body x (side: +1 left, -1 right), so that a positive
lateral angle swings the paw outward. Gravity g enters as the acceleration -g of the hip. The "plane" is the five-bar's,
housing x and z; housing axes are body axes turned by the lateral motor.
"""

import warp as wp

from ..kinematics.five_bar import FiveBar, five_bar, five_bar_bias
from ..kinematics.geometry import LegGeometry
from ..kinematics.trig import sin_cos
from ..scalar import mat33, real, vec2, vec3, vec5
from .inertia import MassMoments, inertia_mul, mul_plane, rotate_x, rotate_x_plane, rotate_x_second, sym_outer
from .leg_links import LinkSums, inner_sums, leg_sums, outer_sums


@wp.struct
class LegMasses:
    """Mass moments of the leg's links, each about its own link frame."""

    housing: MassMoments
    outer_thigh: MassMoments
    outer_shank: MassMoments
    inner_thigh: MassMoments
    inner_shank: MassMoments


@wp.struct
class LegPose:
    """Configuration of a leg: five-bar in the motor housing, and the housing's rotation about body x."""

    loop: FiveBar
    cosine: real  # of the rotation, the lateral angle times `LegGeometry.side`
    sine: real


@wp.struct
class LegDynamics:
    """Inertia of one leg in motor space, its inertial couplings to the base, and its bias (velocity, gravity) forces.

    Columns of Bv, Bw and D are lateral, outer, inner.
    """

    body: MassMoments  # of the whole leg about the base origin
    coupling_lin: mat33  # Bv: linear momentum per motor rate [kg m]
    coupling_ang: mat33  # Bw: angular momentum about the base origin per motor rate [kg m^2]
    inertia: mat33  # D: motor-space inertia of the links [kg m^2]
    bias_force: vec3  # F [N], gravity included
    bias_moment: vec3  # N [N m]
    bias_torque: vec3  # h [N m]


@wp.struct
class PawKinematics:
    """Position and Jacobians of the centre of the paw, `paw_offset` from the ankle along the inner shank, body axes."""

    position: vec3  # [m] from the base origin
    jacobian: mat33  # [m/rad] d position / d (lateral, outer, inner)
    spin: mat33  # [1] angular velocity of the paw per motor rate


@wp.func
def leg_pose(geo: LegGeometry, angles: vec3) -> LegPose:
    """Return a leg's configuration, five-bar and housing rotation, for motor angles [rad] lateral, outer, inner."""
    lateral_sin_cos = sin_cos(angles[0])
    pose = LegPose()
    pose.loop = five_bar(geo, angles[1], angles[2])
    pose.cosine = lateral_sin_cos[1]
    pose.sine = geo.side * lateral_sin_cos[0]
    return pose


@wp.func
def columns(a: vec3, b: vec3, c: vec3) -> mat33:
    """Return the 3x3 matrix whose columns are the vectors a, b, c."""
    return mat33(a[0], b[0], c[0], a[1], b[1], c[1], a[2], b[2], c[2])


@wp.func
def paw_kinematics(geo: LegGeometry, pose: LegPose) -> PawKinematics:
    """Return the position and Jacobians of the centre of a leg's paw in body axes.

    The paw is part of the inner shank and turns with it.
    """
    loop, cosine, sine = pose.loop, pose.cosine, pose.sine
    zero = real(0.0)
    y = geo.plane_y + geo.knee_y
    x, z = loop.paw[0], loop.paw[1]
    paw = PawKinematics()
    paw.position = geo.hip + rotate_x(vec3(x, y, z), cosine, sine)
    paw.jacobian = columns(
        geo.side * vec3(zero, -(sine * y + cosine * z), cosine * y - sine * z),
        rotate_x_plane(loop.paw_do, cosine, sine),
        rotate_x_plane(loop.paw_di, cosine, sine),
    )
    pitch = vec3(zero, cosine, sine)
    paw.spin = columns(vec3(geo.side, zero, zero), loop.inner_shank_do * pitch, loop.inner_shank_di * pitch)
    return paw


@wp.func
def centrifugal(second_j: vec5, w: vec3) -> real:
    """Return the centrifugal torque [N m] on an outer or inner motor due to the angular velocity of its leg's housing.

    The torque is 1/2 w^T (dI/dq_j) w. second_j: d S / d q_j as in `LinkSums`; w [rad/s]: angular velocity of the
    housing, housing axes.
    """
    return real(0.5) * ((second_j[0] + second_j[1]) * wp.dot(w, w) - wp.dot(w, mul_plane(second_j, w)))


@wp.func
def leg_body(geo: LegGeometry, sums: LinkSums, cosine: real, sine: real) -> MassMoments:
    """Return a leg's mass and its moments of mass about the base origin, body axes; cosine, sine: see `LegPose`.

    The function turns the sums, which are about the hip in housing axes, to body axes, and shifts them by the position
    of the hip.
    """
    first = rotate_x(sums.first, cosine, sine)
    body = MassMoments()
    body.mass = sums.mass
    body.first = first + sums.mass * geo.hip
    body.second = (
        rotate_x_second(sums.second, cosine, sine)
        + sym_outer(geo.hip, first)
        + real(0.5) * sums.mass * sym_outer(geo.hip, geo.hip)
    )
    return body


@wp.func
def couple_leg(geo: LegGeometry, sums: LinkSums, cosine: real, sine: real) -> LegDynamics:
    """Return a leg's inertia and its couplings to the base, with zero bias forces; cosine, sine: see `LegPose`.

    A column of the couplings is the leg's linear and angular momentum about the base origin at a unit rate of one motor
    (l, o, i: lateral, outer, inner).
    """
    leg = LegDynamics()
    second = sums.second
    lateral_ang = geo.side * vec3(second[1] + second[2], -second[3], -second[4])  # of a unit rate about x
    lateral_lin = geo.side * vec3(real(0.0), -sums.first[2], sums.first[1])
    lo = geo.side * sums.ang_o[0]
    li = geo.side * sums.ang_i[0]
    leg.inertia = mat33(
        geo.side * lateral_ang[0], lo, li, lo, sums.inertia_oo, sums.inertia_oi, li, sums.inertia_oi, sums.inertia_ii
    )
    lin_l = rotate_x(lateral_lin, cosine, sine)
    lin_o = rotate_x_plane(sums.lin_o, cosine, sine)
    lin_i = rotate_x_plane(sums.lin_i, cosine, sine)
    leg.coupling_lin = columns(lin_l, lin_o, lin_i)
    leg.coupling_ang = columns(
        rotate_x(lateral_ang, cosine, sine) + wp.cross(geo.hip, lin_l),
        rotate_x(sums.ang_o, cosine, sine) + wp.cross(geo.hip, lin_o),
        rotate_x(sums.ang_i, cosine, sine) + wp.cross(geo.hip, lin_i),
    )
    return leg


@wp.func
def assemble_leg(
    geo: LegGeometry, sums: LinkSums, cosine: real, sine: real, rates: vec3, omega: vec3, g: vec3
) -> LegDynamics:
    """Return a leg's inertia, couplings to the base and bias forces from the mass integrals of its links.

    rates: motor rates [rad/s]; omega: base angular velocity [rad/s], g: gravity [m/s^2], both in body axes; cosine,
    sine: see `LegPose`. Bias forces result from the motion of the leg while all accelerations (a, alpha, q'') are zero.
    They are computed in the housing frame, which turns with w and has an angular acceleration w_acc, and then turned to
    body axes.
    """
    zero = real(0.0)
    lateral_rate = geo.side * rates[0]
    omega_m = rotate_x(omega, cosine, -sine)  # of the base, in housing axes
    w = omega_m + vec3(lateral_rate, zero, zero)  # of the housing
    w_acc = vec3(zero, omega_m[2] * lateral_rate, -omega_m[1] * lateral_rate)
    hip_acc = rotate_x(wp.cross(omega, wp.cross(omega, geo.hip)) - g, cosine, -sine)
    hip_plane = vec2(hip_acc[0], hip_acc[2])

    lin_rel = rates[1] * sums.lin_o + rates[2] * sums.lin_i
    ang_rel = rates[1] * sums.ang_o + rates[2] * sums.ang_i
    second_rate = rates[1] * sums.second_o + rates[2] * sums.second_i
    coriolis_momentum = wp.cross(w, sums.first) + real(2.0) * vec3(lin_rel[0], zero, lin_rel[1])
    force = (
        sums.mass * hip_acc
        + wp.cross(w_acc, sums.first)
        + wp.cross(w, coriolis_momentum)
        + vec3(sums.lin_acc[0], zero, sums.lin_acc[1])
    )
    moment = (
        wp.cross(sums.first, hip_acc)
        + inertia_mul(sums.second, w_acc)
        + wp.cross(w, inertia_mul(sums.second, w) + ang_rel)
        + (second_rate[0] + second_rate[1]) * w
        - mul_plane(second_rate, w)
        + sums.ang_acc
    )
    coriolis_torque = w[1] * sums.coriolis

    leg = couple_leg(geo, sums, cosine, sine)
    leg.bias_torque = vec3(
        geo.side * moment[0],
        wp.dot(sums.lin_o, hip_plane)
        + wp.dot(sums.ang_o, w_acc)
        - centrifugal(sums.second_o, w)
        + coriolis_torque * rates[2]
        + sums.bias_o,
        wp.dot(sums.lin_i, hip_plane)
        + wp.dot(sums.ang_i, w_acc)
        - centrifugal(sums.second_i, w)
        - coriolis_torque * rates[1]
        + sums.bias_i,
    )
    leg.bias_force = rotate_x(force, cosine, sine)
    leg.bias_moment = rotate_x(moment, cosine, sine) + wp.cross(geo.hip, leg.bias_force)
    leg.body = leg_body(geo, sums, cosine, sine)
    return leg


@wp.func
def leg_dynamics(geo: LegGeometry, masses: LegMasses, pose: LegPose, rates: vec3, omega: vec3, g: vec3) -> LegDynamics:
    """Return a leg's inertia, couplings to the base and bias forces for its pose, its motor rates and the base's rate.

    rates [rad/s] of the motors; omega [rad/s], g [m/s^2]: rotation of the base and gravity, body axes.
    """
    bias = five_bar_bias(geo, pose.loop, rates[1], rates[2])
    outer = outer_sums(geo, masses.outer_thigh, masses.outer_shank, pose.loop, bias)
    inner = inner_sums(geo, masses.inner_thigh, masses.inner_shank, pose.loop, bias)
    sums = leg_sums(masses.housing, outer, inner)
    return assemble_leg(geo, sums, pose.cosine, pose.sine, rates, omega, g)
