"""Virtual power of a step: equations of motion times adjoint multipliers, which the reverse pass differentiates.

A step solves M (v' - v) = dt f + J^T p for the new velocities v' (f: forces, p: contact impulses). For multipliers m,
one per velocity, the scalar is

    m . (dt f + J^T p - M (v' - v)),    with m, v', p and the accelerations (v' - v) / dt constant.

By d'Alembert's principle the inertia part is a sum over links, so that no matrix is formed. m gives each link's frame a
virtual velocity v* and a virtual angular velocity w*, and the link contributes -dt P with

    P = v* . f + w* . n,
    f = m a + w' x s + w x (w x s),         s = m c, the first mass moment
    n = s x a + I w' + w x (I w),

where a is the frame's acceleration less gravity, w and w' its angular velocity and acceleration, all in its own axes.
With u = w x s, h = I w, and their adjoints u* = v* x w, h* = w* x w, the partial derivatives are

    by v*: f          by a:  m v* + w* x s        by w: u x v* + s x u* + h x w* + I h*
    by w*: n          by w': s x v* + I w*        by m: v* . a
    by s:  v* x w' + u* x w + a x w*
    by S:  (w* . w' + h* . w) 1 - sym(w*, w') - sym(h*, w),   as I = tr(S) 1 - S and d(a^T S b) = sym(a, b) : dS.

`adj_inertia_power` and `adj_link_motion` are written by hand; Warp generates all other adjoints. A multiplier has the
unit of the differentiated number per momentum.
"""

import warp as wp

from ...actuation.joint_forces import JointParams, joint_forces
from ...actuation.springs import LegSpring, spring_torque
from ...actuation.stops import StopParams, StopRates, stop_rates
from ...kinematics.five_bar import FiveBar, five_bar_bias
from ...kinematics.geometry import LegGeometry
from ...scalar import quat, real, vec2, vec3, vec6
from ...terrain.ground import Ground, floor_distance, floor_normal
from ..base_motion import exp_rotation
from ..contact import SEPARATE, contact_jacobian, target_normal_velocity
from ..contact_laws import contact_residual
from ..inertia import MassMoments, inertia_mul, rotate_x, rotate_y
from ..leg_dynamics import LegMasses, PawKinematics, leg_pose, paw_kinematics


@wp.struct
class BaseFactors:
    """Adjoint multipliers and motion of the base in a step, held constant while its virtual power is differentiated.

    The axes are the body axes at the start of the step.
    """

    virtual_lin: vec3  # multipliers of the base's linear equations
    virtual_ang: vec3  # multipliers of the base's angular equations
    lin_acc: vec3  # [m/s^2] over the step, contact included
    ang_acc: vec3  # [rad/s^2]
    lin: vec3  # [m/s] at the end of the step
    ang: vec3  # [rad/s]


@wp.struct
class LegFactors:
    """Adjoint multipliers, motor motion and contact of a leg, constant while its virtual power is differentiated.

    Vectors are lateral, outer, inner, or belong to the contact of the paw.
    """

    virtual_rates: vec3  # multipliers of the motors' equations
    acc: vec3  # [rad/s^2] over the step, contact included
    rates: vec3  # [rad/s] at the end of the step
    mode: int  # SEPARATE, STICK or SLIDE
    pressed: int  # set of pressed hard stops, see `stops`
    impulse: vec3  # [N s] on the paw, body axes
    law: vec3  # multiplier of the contact law, body axes
    push: vec3  # gradient of the loss w.r.t. the impulse as the trajectory stores it, world axes


@wp.struct
class FrameMotion:
    """Acceleration, rotation and virtual velocity of a link's frame, in its own axes; symbols: see the module."""

    virtual_lin: vec3  # v*
    virtual_ang: vec3  # w*
    acc: vec3  # a [m/s^2], of its origin, less gravity
    ang: vec3  # w [rad/s]
    ang_acc: vec3  # w' [rad/s^2]


@wp.func
def add(a: FrameMotion, b: FrameMotion) -> FrameMotion:
    """Return the sum of two frame motions, a + b; Warp calls it for `wp.adjoint[frame] += ...`."""
    c = FrameMotion()
    c.virtual_lin = a.virtual_lin + b.virtual_lin
    c.virtual_ang = a.virtual_ang + b.virtual_ang
    c.acc = a.acc + b.acc
    c.ang = a.ang + b.ang
    c.ang_acc = a.ang_acc + b.ang_acc
    return c


@wp.func
def add(a: MassMoments, b: MassMoments) -> MassMoments:  # noqa: F811
    """Return the sum of two sets of mass moments, a + b; Warp calls it for `wp.adjoint[body] += ...`."""
    c = MassMoments()
    c.mass = a.mass + b.mass
    c.first = a.first + b.first
    c.second = a.second + b.second
    return c


@wp.func
def second_moment_product(a: vec3, b: vec3) -> vec6:
    """Return the gradient of a^T S b w.r.t. packed second moments S (xx yy zz xy xz yz), sym(a, b) of the module."""
    return vec6(
        a[0] * b[0], a[1] * b[1], a[2] * b[2],
        a[0] * b[1] + a[1] * b[0], a[0] * b[2] + a[2] * b[0], a[1] * b[2] + a[2] * b[1],
    )  # fmt: skip


@wp.func
def inertia_power(body: MassMoments, frame: FrameMotion) -> real:
    """Return the virtual power of a link's inertia: P in the module's docstring; body: moments in the link's frame."""
    acc, ang, ang_acc = frame.acc, frame.ang, frame.ang_acc
    force = body.mass * acc + wp.cross(ang_acc, body.first) + wp.cross(ang, wp.cross(ang, body.first))
    moment = (
        wp.cross(body.first, acc)
        + inertia_mul(body.second, ang_acc)
        + wp.cross(ang, inertia_mul(body.second, ang))
    )  # fmt: skip
    return wp.dot(frame.virtual_lin, force) + wp.dot(frame.virtual_ang, moment)


@wp.func_grad(inertia_power)
def adj_inertia_power(body: MassMoments, frame: FrameMotion, adj_ret: real):
    """Adjoint of `inertia_power`: add adj_ret times its partial derivatives to `wp.adjoint`; u, h: see the module."""
    acc, ang, ang_acc = frame.acc, frame.ang, frame.ang_acc
    lin_v, ang_v, first = frame.virtual_lin, frame.virtual_ang, body.first
    u = wp.cross(ang, first)
    h = inertia_mul(body.second, ang)
    adj_u = wp.cross(lin_v, ang)
    adj_h = wp.cross(ang_v, ang)
    adj_frame = FrameMotion()
    adj_frame.virtual_lin = adj_ret * (body.mass * acc + wp.cross(ang_acc, first) + wp.cross(ang, u))
    adj_frame.virtual_ang = adj_ret * (wp.cross(first, acc) + inertia_mul(body.second, ang_acc) + wp.cross(ang, h))
    adj_frame.acc = adj_ret * (body.mass * lin_v + wp.cross(ang_v, first))
    adj_frame.ang_acc = adj_ret * (wp.cross(first, lin_v) + inertia_mul(body.second, ang_v))
    adj_frame.ang = adj_ret * (
        wp.cross(u, lin_v) + wp.cross(first, adj_u) + wp.cross(h, ang_v) + inertia_mul(body.second, adj_h)
    )
    adj_body = MassMoments()
    adj_body.mass = adj_ret * wp.dot(lin_v, acc)
    adj_body.first = adj_ret * (wp.cross(lin_v, ang_acc) + wp.cross(adj_u, ang) + wp.cross(acc, ang_v))
    adj_trace = wp.dot(ang_v, ang_acc) + wp.dot(adj_h, ang)
    adj_body.second = adj_ret * (
        vec6(adj_trace, adj_trace, adj_trace, real(0.0), real(0.0), real(0.0))
        - second_moment_product(ang_v, ang_acc)
        - second_moment_product(adj_h, ang)
    )
    wp.adjoint[body] += adj_body
    wp.adjoint[frame] += adj_frame


@wp.func
def planar(v: vec2) -> vec3:
    """Return a vector (x, z) of the five-bar's plane as a 3D vector (x, 0, z) in housing axes."""
    return vec3(v[0], real(0.0), v[1])


@wp.func
def planar_dot(a: vec3, b: vec3) -> real:
    """Return the dot product of two vectors in the five-bar's plane: a_x b_x + a_z b_z."""
    return a[0] * b[0] + a[2] * b[2]


@wp.func
def planar_cross(a: vec3, b: vec3) -> real:
    """Return the y component of the cross product of two vectors in the five-bar's plane: a_z b_x - a_x b_z."""
    return a[2] * b[0] - a[0] * b[2]


@wp.func
def link_motion(
    housing: FrameMotion, origin: vec3, vel: vec2, acc: vec2, virtual: vec2, about_y: vec3, cosine: real, sine: real
) -> FrameMotion:
    """Return motion and virtual velocity of a link's frame, in its axes, from the motion of its leg's motor housing.

    origin [m], vel [m/s], acc [m/s^2], virtual velocity of the link frame's origin relative to the housing, in housing
    axes; the last three in the five-bar's plane, (x, z). about_y: the link's rate [rad/s], acceleration [rad/s^2] and
    virtual rate about +y. cosine, sine of the link's rotation about +y.
    """
    w = housing.ang
    link = FrameMotion()
    link.virtual_lin = rotate_y(
        housing.virtual_lin + wp.cross(housing.virtual_ang, origin) + planar(virtual), cosine, -sine
    )
    link.virtual_ang = rotate_y(housing.virtual_ang, cosine, -sine) + vec3(real(0.0), about_y[2], real(0.0))
    link.acc = rotate_y(
        housing.acc
        + wp.cross(housing.ang_acc, origin)
        + wp.cross(w, wp.cross(w, origin) + real(2.0) * planar(vel))
        + planar(acc),
        cosine,
        -sine,
    )
    link.ang = rotate_y(w, cosine, -sine) + vec3(real(0.0), about_y[0], real(0.0))
    link.ang_acc = rotate_y(housing.ang_acc + vec3(-w[2] * about_y[0], about_y[1], w[0] * about_y[0]), cosine, -sine)
    return link


@wp.func_grad(link_motion)
def adj_link_motion(
    housing: FrameMotion, origin: vec3, vel: vec2, acc: vec2, virtual: vec2, about_y: vec3, cosine: real, sine: real,
    adj_ret: FrameMotion,
):  # fmt: skip
    """Adjoint of `link_motion`: add the gradient w.r.t. its arguments to `wp.adjoint`.

    adj_ret: gradient w.r.t. its result; adj_* locals: in housing axes.
    """
    w = housing.ang
    # in housing axes
    relative_vel = wp.cross(w, origin) + real(2.0) * planar(vel)
    lin_v = housing.virtual_lin + wp.cross(housing.virtual_ang, origin) + planar(virtual)
    frame_acc = housing.acc + wp.cross(housing.ang_acc, origin) + wp.cross(w, relative_vel) + planar(acc)
    frame_ang_acc = housing.ang_acc + vec3(-w[2] * about_y[0], about_y[1], w[0] * about_y[0])
    adj_lin_v = rotate_y(adj_ret.virtual_lin, cosine, sine)
    adj_ang_v = rotate_y(adj_ret.virtual_ang, cosine, sine)
    adj_acc = rotate_y(adj_ret.acc, cosine, sine)
    adj_ang = rotate_y(adj_ret.ang, cosine, sine)
    adj_ang_acc = rotate_y(adj_ret.ang_acc, cosine, sine)
    adj_relative_vel = wp.cross(adj_acc, w)
    adj_housing = FrameMotion()
    adj_housing.virtual_lin = adj_lin_v
    adj_housing.virtual_ang = adj_ang_v + wp.cross(origin, adj_lin_v)
    adj_housing.acc = adj_acc
    adj_housing.ang_acc = adj_ang_acc + wp.cross(origin, adj_acc)
    adj_housing.ang = (
        adj_ang
        + wp.cross(relative_vel, adj_acc)
        + wp.cross(origin, adj_relative_vel)
        + about_y[0] * vec3(adj_ang_acc[2], real(0.0), -adj_ang_acc[0])
    )
    wp.adjoint[housing] += adj_housing
    wp.adjoint[origin] += (
        wp.cross(adj_lin_v, housing.virtual_ang) + wp.cross(adj_acc, housing.ang_acc) + wp.cross(adj_relative_vel, w)
    )
    wp.adjoint[vel] += real(2.0) * vec2(adj_relative_vel[0], adj_relative_vel[2])
    wp.adjoint[acc] += vec2(adj_acc[0], adj_acc[2])
    wp.adjoint[virtual] += vec2(adj_lin_v[0], adj_lin_v[2])
    wp.adjoint[about_y] += vec3(
        adj_ret.ang[1] + adj_ang_acc[2] * w[0] - adj_ang_acc[0] * w[2], adj_ang_acc[1], adj_ret.virtual_ang[1]
    )
    adj_cosine = planar_dot(adj_ret.virtual_lin, lin_v) + planar_dot(adj_ret.virtual_ang, housing.virtual_ang)
    adj_cosine += (
        planar_dot(adj_ret.acc, frame_acc) + planar_dot(adj_ret.ang, w) + planar_dot(adj_ret.ang_acc, frame_ang_acc)
    )
    adj_sine = planar_cross(adj_ret.virtual_lin, lin_v) + planar_cross(adj_ret.virtual_ang, housing.virtual_ang)
    adj_sine += planar_cross(adj_ret.acc, frame_acc) + planar_cross(adj_ret.ang, w)
    adj_sine += planar_cross(adj_ret.ang_acc, frame_ang_acc)
    wp.adjoint[cosine] += adj_cosine
    wp.adjoint[sine] += adj_sine


@wp.func
def housing_motion(
    geo: LegGeometry, rate: real, omega: vec3, g: vec3, c: real, s: real, base: BaseFactors, leg: LegFactors
) -> FrameMotion:
    """Return motion and virtual velocity of a leg's motor housing frame, in housing axes.

    rate [rad/s] of the lateral motor. omega [rad/s], g [m/s^2]: rotation of the base and gravity, body axes. c, s:
    cosine and sine of the housing's rotation about body x.
    """
    zero = real(0.0)
    lateral_rate = geo.side * rate
    base_ang = rotate_x(omega, c, -s)
    housing = FrameMotion()
    housing.virtual_lin = rotate_x(base.virtual_lin + wp.cross(base.virtual_ang, geo.hip), c, -s)
    housing.virtual_ang = rotate_x(base.virtual_ang, c, -s) + vec3(geo.side * leg.virtual_rates[0], zero, zero)
    housing.acc = rotate_x(
        base.lin_acc - g + wp.cross(base.ang_acc, geo.hip) + wp.cross(omega, wp.cross(omega, geo.hip)), c, -s
    )
    housing.ang = base_ang + vec3(lateral_rate, zero, zero)
    housing.ang_acc = rotate_x(base.ang_acc, c, -s) + vec3(
        geo.side * leg.acc[0], base_ang[2] * lateral_rate, -base_ang[1] * lateral_rate
    )
    return housing


@wp.func
def passive_power(
    joints: JointParams, loop: FiveBar, front: real, rates: vec3, stop_rates: StopRates, leg: LegFactors, dt: real
) -> real:
    """Return the virtual power of a leg's friction, damping, pressed stops and armature; inputs: `joint_forces`."""
    passive = joint_forces(joints, loop, front, rates, stop_rates, leg.pressed, dt)
    implicit = passive.inertia * leg.acc + wp.cw_mul(joints.armature, leg.acc)
    return wp.dot(leg.virtual_rates, passive.torque - implicit)


@wp.func
def contact_action(
    geo: LegGeometry, ground: Ground, mu: real, pos: vec3, orientation: quat, paw: PawKinematics, base: BaseFactors,
    leg: LegFactors, dt: real,
) -> real:  # fmt: skip
    """Return the virtual power of one paw's contact in a step, for the reverse pass to differentiate.

    The power is impulse . virtual velocity + multiplier . law + cotangent . impulse. mu: friction coefficient. pos [m],
    orientation (xyzw) of the base, world, at the start of the step dt [s].
    """
    centre = pos + wp.quat_rotate(orientation, paw.position)
    normal = wp.quat_rotate_inv(orientation, floor_normal(ground, centre))
    gap = floor_distance(ground, centre) - geo.paw_radius
    arm = -geo.paw_radius * normal
    point = paw.position + arm
    jacobian = contact_jacobian(paw, arm)
    virtual = base.virtual_lin + wp.cross(base.virtual_ang, point) + jacobian * leg.virtual_rates
    velocity = base.lin + wp.cross(base.ang, point) + jacobian * leg.rates
    goal = target_normal_velocity(gap, leg.pressed, dt)
    residual = contact_residual(leg.impulse, velocity, normal, goal, mu, leg.mode)
    action = wp.dot(leg.impulse, virtual) + wp.dot(leg.law, residual)
    return action + wp.dot(leg.push, wp.quat_rotate(orientation, leg.impulse))


@wp.func
def leg_action(
    geo: LegGeometry, masses: LegMasses, joints: JointParams, spring: LegSpring, stops: StopParams, ground: Ground,
    mu: real, pos: vec3, orientation: quat, omega: vec3, g: vec3, angles: vec3, rates: vec3, base: BaseFactors,
    leg: LegFactors, dt: real,
) -> real:  # fmt: skip
    """Return a leg's part of a step's virtual power: links, passive forces, spring and contact, without motor torques.

    mu: friction coefficient. pos [m], orientation (xyzw) of the base, world. omega [rad/s] of the base and gravity g
    [m/s^2] are in body axes. angles [rad], rates [rad/s]: lateral, outer, inner, at the start of the step.
    """
    zero = real(0.0)
    pose = leg_pose(geo, angles)
    loop, c, s = pose.loop, pose.cosine, pose.sine
    bias = five_bar_bias(geo, loop, rates[1], rates[2])
    outer_acc, inner_acc = leg.acc[1], leg.acc[2]
    outer_virtual, inner_virtual = leg.virtual_rates[1], leg.virtual_rates[2]
    housing = housing_motion(geo, rates[0], omega, g, c, s, base, leg)
    f = geo.front
    still = vec2(zero)
    outer_thigh = link_motion(
        housing, vec3(geo.outer_x, geo.plane_y, zero), still, still, still,
        vec3(bias.outer_thigh_rate, -f * outer_acc, -f * outer_virtual), loop.outer_sin_cos[1],
        -f * loop.outer_sin_cos[0],
    )  # fmt: skip
    inner_thigh = link_motion(
        housing, vec3(geo.inner_x, geo.plane_y, zero), still, still, still,
        vec3(bias.inner_thigh_rate, f * inner_acc, f * inner_virtual), loop.inner_sin_cos[1], f * loop.inner_sin_cos[0],
    )  # fmt: skip
    knee_y = geo.plane_y + geo.knee_y
    outer_shank = link_motion(
        housing, vec3(loop.outer_knee[0], knee_y, loop.outer_knee[1]),
        rates[1] * loop.outer_knee_do, outer_acc * loop.outer_knee_do + bias.outer_knee_acc,
        outer_virtual * loop.outer_knee_do,
        vec3(
            bias.outer_shank_rate,
            loop.outer_shank_do * outer_acc + loop.outer_shank_di * inner_acc + bias.outer_shank_acc,
            loop.outer_shank_do * outer_virtual + loop.outer_shank_di * inner_virtual,
        ),
        -loop.outer_shank[1], -loop.outer_shank[0],
    )  # fmt: skip
    inner_shank = link_motion(
        housing, vec3(loop.inner_knee[0], knee_y, loop.inner_knee[1]),
        rates[2] * loop.inner_knee_di, inner_acc * loop.inner_knee_di + bias.inner_knee_acc,
        inner_virtual * loop.inner_knee_di,
        vec3(
            bias.inner_shank_rate,
            loop.inner_shank_do * outer_acc + loop.inner_shank_di * inner_acc + bias.inner_shank_acc,
            loop.inner_shank_do * outer_virtual + loop.inner_shank_di * inner_virtual,
        ),
        -loop.inner_shank[1], -loop.inner_shank[0],
    )  # fmt: skip
    power = (
        inertia_power(masses.housing, housing)
        + inertia_power(masses.outer_thigh, outer_thigh)
        + inertia_power(masses.inner_thigh, inner_thigh)
        + inertia_power(masses.outer_shank, outer_shank)
        + inertia_power(masses.inner_shank, inner_shank)
    )
    action = dt * (passive_power(joints, loop, f, rates, stop_rates(stops, angles, dt), leg, dt) - power)
    if spring.stiffness != zero:
        action += dt * wp.dot(leg.virtual_rates, spring_torque(spring, loop))
    if leg.mode != SEPARATE:
        action += contact_action(geo, ground, mu, pos, orientation, paw_kinematics(geo, pose), base, leg, dt)
    return action


@wp.struct
class BaseCotangent:
    """Gradients of the loss w.r.t. gravity and velocities of the base, inputs of `base_action`."""

    velocity: vec3  # w.r.t. its linear velocity at the start of the step, body axes
    new_velocity: vec3  # w.r.t. its linear velocity at the end of the step, world axes
    gravity: vec3  # w.r.t. gravity in body axes


@wp.func
def base_action(
    body: MassMoments, com: vec3, gravity: vec3, force: vec3, moment: vec3, orientation: quat, lin: vec3, omega: vec3,
    base: BaseFactors, cotangent: BaseCotangent, dt: real,
) -> real:  # fmt: skip
    """Return the base's part of a step's virtual power, plus dot products that backpropagate through changes of axes.

    The dot products are between `cotangent` and gravity and velocities, in the axes of `BaseCotangent`. gravity
    [m/s^2], external force [N] and moment [N m] at the com, lin [m/s]: world axes; com [m], omega [rad/s]: body axes;
    orientation: xyzw.
    """
    g = wp.quat_rotate_inv(orientation, gravity)
    frame = FrameMotion()
    frame.virtual_lin = base.virtual_lin
    frame.virtual_ang = base.virtual_ang
    frame.acc = base.lin_acc - g
    frame.ang = omega
    frame.ang_acc = base.ang_acc
    push = wp.quat_rotate_inv(orientation, force)
    twist = wp.quat_rotate_inv(orientation, moment) + wp.cross(com, push)
    power = wp.dot(base.virtual_lin, push) + wp.dot(base.virtual_ang, twist) - inertia_power(body, frame)
    return (
        dt * power
        + wp.dot(cotangent.gravity, g)
        + wp.dot(cotangent.velocity, wp.quat_rotate_inv(orientation, lin))
        + wp.dot(cotangent.new_velocity, wp.quat_rotate(orientation, base.lin))
    )


@wp.func
def rotation_adjoint_scalar(orientation: quat, ang: vec3, dt: real, cotangent: quat) -> real:
    """Return a scalar whose gradient (`wp.grad`) is the adjoint of integrating the base's orientation over dt [s].

    The scalar is cotangent . (orientation after dt at ang [rad/s], body axes).
    """
    return wp.dot(cotangent, wp.normalize(orientation * exp_rotation(dt * ang)))
