"""The step's equations of motion, weighed: one number whose derivatives are what the reverse pass adds up.

A step solves M (v' - v) = dt f + J^T p. With multipliers m, one for each velocity, the number is

    m . (dt f + J^T p - M (v' - v)),

in which v', p and m are held. It is a sum over the links of d'Alembert's virtual power, the inertia forces of each link
at the accelerations of the step on the virtual velocities m, so no matrix is formed, let alone inverted.
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
    """What is held of the base: virtual velocities (multipliers), accelerations and new velocities, body axes."""

    virtual_lin: vec3
    virtual_ang: vec3
    lin_acc: vec3  # [m/s^2] over the step, contact included
    ang_acc: vec3  # [rad/s^2]
    lin: vec3  # [m/s] at the end of the step
    ang: vec3  # [rad/s]


@wp.struct
class LegFactors:
    """What is held of a leg: multipliers, accelerations and new rates of its motors, and its paw's contact."""

    virtual_rates: vec3
    acc: vec3  # [rad/s^2] over the step, contact included
    rates: vec3  # [rad/s] at the end of the step
    mode: int  # SEPARATE, STICK or SLIDE
    pressed: int  # set of hard stops
    impulse: vec3  # [N s] on the paw, body axes
    law: vec3  # multiplier of the contact law
    push: vec3  # weight of the impulse, world axes


@wp.struct
class FrameMotion:
    """A frame's virtual velocity and its motion, in its own axes; acceleration less gravity."""

    virtual_lin: vec3
    virtual_ang: vec3
    acc: vec3  # [m/s^2]
    ang: vec3  # [rad/s]
    ang_acc: vec3  # [rad/s^2]


@wp.func
def add(a: FrameMotion, b: FrameMotion) -> FrameMotion:
    """Return a + b, for the adjoints below."""
    c = FrameMotion()
    c.virtual_lin = a.virtual_lin + b.virtual_lin
    c.virtual_ang = a.virtual_ang + b.virtual_ang
    c.acc = a.acc + b.acc
    c.ang = a.ang + b.ang
    c.ang_acc = a.ang_acc + b.ang_acc
    return c


@wp.func
def add(a: MassMoments, b: MassMoments) -> MassMoments:  # noqa: F811
    """Return a + b."""
    c = MassMoments()
    c.mass = a.mass + b.mass
    c.first = a.first + b.first
    c.second = a.second + b.second
    return c


@wp.func
def second_moment_product(a: vec3, b: vec3) -> vec6:
    """Return the derivative of a^T S b by packed second moments S."""
    return vec6(
        a[0] * b[0], a[1] * b[1], a[2] * b[2],
        a[0] * b[1] + a[1] * b[0], a[0] * b[2] + a[2] * b[0], a[1] * b[2] + a[2] * b[1],
    )  # fmt: skip


@wp.func
def inertia_power(body: MassMoments, frame: FrameMotion) -> real:
    """Return the virtual power [W] of a rigid body's inertia and weight; moments about the frame, in its axes."""
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
    """Add the gradient of `inertia_power`."""
    acc, ang, ang_acc = frame.acc, frame.ang, frame.ang_acc
    lin_v, ang_v, first = frame.virtual_lin, frame.virtual_ang, body.first
    swing = wp.cross(ang, first)
    spin = inertia_mul(body.second, ang)
    by_swing = wp.cross(lin_v, ang)
    by_spin = wp.cross(ang_v, ang)
    by_frame = FrameMotion()
    by_frame.virtual_lin = adj_ret * (body.mass * acc + wp.cross(ang_acc, first) + wp.cross(ang, swing))
    by_frame.virtual_ang = adj_ret * (wp.cross(first, acc) + inertia_mul(body.second, ang_acc) + wp.cross(ang, spin))
    by_frame.acc = adj_ret * (body.mass * lin_v + wp.cross(ang_v, first))
    by_frame.ang_acc = adj_ret * (wp.cross(first, lin_v) + inertia_mul(body.second, ang_v))
    by_frame.ang = adj_ret * (
        wp.cross(swing, lin_v) + wp.cross(first, by_swing) + wp.cross(spin, ang_v) + inertia_mul(body.second, by_spin)
    )
    by_body = MassMoments()
    by_body.mass = adj_ret * wp.dot(lin_v, acc)
    by_body.first = adj_ret * (wp.cross(lin_v, ang_acc) + wp.cross(by_swing, ang) + wp.cross(acc, ang_v))
    turn = wp.dot(ang_v, ang_acc) + wp.dot(by_spin, ang)
    by_body.second = adj_ret * (
        vec6(turn, turn, turn, real(0.0), real(0.0), real(0.0))
        - second_moment_product(ang_v, ang_acc)
        - second_moment_product(by_spin, ang)
    )
    wp.adjoint[body] += by_body
    wp.adjoint[frame] += by_frame


@wp.func
def planar(v: vec2) -> vec3:
    """Return (x, 0, z)."""
    return vec3(v[0], real(0.0), v[1])


@wp.func
def planar_dot(a: vec3, b: vec3) -> real:
    """Return a_x b_x + a_z b_z."""
    return a[0] * b[0] + a[2] * b[2]


@wp.func
def planar_cross(a: vec3, b: vec3) -> real:
    """Return a_z b_x - a_x b_z."""
    return a[2] * b[0] - a[0] * b[2]


@wp.func
def link_motion(
    housing: FrameMotion, origin: vec3, vel: vec2, acc: vec2, virtual: vec2, turn: vec3, cosine: real, sine: real
) -> FrameMotion:
    """Return the motion of a link's frame in the housing, in the link's axes.

    vel [m/s], acc [m/s^2], virtual: of its origin in the housing's plane. turn: rate [rad/s], acceleration [rad/s^2]
    and virtual rate about y. cosine, sine: of its angle about y.
    """
    w = housing.ang
    link = FrameMotion()
    link.virtual_lin = rotate_y(
        housing.virtual_lin + wp.cross(housing.virtual_ang, origin) + planar(virtual), cosine, -sine
    )
    link.virtual_ang = rotate_y(housing.virtual_ang, cosine, -sine) + vec3(real(0.0), turn[2], real(0.0))
    link.acc = rotate_y(
        housing.acc
        + wp.cross(housing.ang_acc, origin)
        + wp.cross(w, wp.cross(w, origin) + real(2.0) * planar(vel))
        + planar(acc),
        cosine,
        -sine,
    )
    link.ang = rotate_y(w, cosine, -sine) + vec3(real(0.0), turn[0], real(0.0))
    link.ang_acc = rotate_y(housing.ang_acc + vec3(-w[2] * turn[0], turn[1], w[0] * turn[0]), cosine, -sine)
    return link


@wp.func_grad(link_motion)
def adj_link_motion(
    housing: FrameMotion, origin: vec3, vel: vec2, acc: vec2, virtual: vec2, turn: vec3, cosine: real, sine: real,
    adj_ret: FrameMotion,
):  # fmt: skip
    """Add the gradient of `link_motion`."""
    w = housing.ang
    # values before they are turned into the link's axes
    swing = wp.cross(w, origin) + real(2.0) * planar(vel)
    lin_v = housing.virtual_lin + wp.cross(housing.virtual_ang, origin) + planar(virtual)
    whole_acc = housing.acc + wp.cross(housing.ang_acc, origin) + wp.cross(w, swing) + planar(acc)
    whole_ang_acc = housing.ang_acc + vec3(-w[2] * turn[0], turn[1], w[0] * turn[0])
    by_lin_v = rotate_y(adj_ret.virtual_lin, cosine, sine)
    by_ang_v = rotate_y(adj_ret.virtual_ang, cosine, sine)
    by_acc = rotate_y(adj_ret.acc, cosine, sine)
    by_ang = rotate_y(adj_ret.ang, cosine, sine)
    by_ang_acc = rotate_y(adj_ret.ang_acc, cosine, sine)
    by_swing = wp.cross(by_acc, w)
    by_housing = FrameMotion()
    by_housing.virtual_lin = by_lin_v
    by_housing.virtual_ang = by_ang_v + wp.cross(origin, by_lin_v)
    by_housing.acc = by_acc
    by_housing.ang_acc = by_ang_acc + wp.cross(origin, by_acc)
    by_housing.ang = (
        by_ang
        + wp.cross(swing, by_acc)
        + wp.cross(origin, by_swing)
        + turn[0] * vec3(by_ang_acc[2], real(0.0), -by_ang_acc[0])
    )
    wp.adjoint[housing] += by_housing
    wp.adjoint[origin] += (
        wp.cross(by_lin_v, housing.virtual_ang) + wp.cross(by_acc, housing.ang_acc) + wp.cross(by_swing, w)
    )
    wp.adjoint[vel] += real(2.0) * vec2(by_swing[0], by_swing[2])
    wp.adjoint[acc] += vec2(by_acc[0], by_acc[2])
    wp.adjoint[virtual] += vec2(by_lin_v[0], by_lin_v[2])
    wp.adjoint[turn] += vec3(
        adj_ret.ang[1] + by_ang_acc[2] * w[0] - by_ang_acc[0] * w[2], by_ang_acc[1], adj_ret.virtual_ang[1]
    )
    along = planar_dot(adj_ret.virtual_lin, lin_v) + planar_dot(adj_ret.virtual_ang, housing.virtual_ang)
    along += (
        planar_dot(adj_ret.acc, whole_acc) + planar_dot(adj_ret.ang, w) + planar_dot(adj_ret.ang_acc, whole_ang_acc)
    )
    across = planar_cross(adj_ret.virtual_lin, lin_v) + planar_cross(adj_ret.virtual_ang, housing.virtual_ang)
    across += planar_cross(adj_ret.acc, whole_acc) + planar_cross(adj_ret.ang, w)
    across += planar_cross(adj_ret.ang_acc, whole_ang_acc)
    wp.adjoint[cosine] += along
    wp.adjoint[sine] += across


@wp.func
def housing_motion(
    geo: LegGeometry, rate: real, omega: vec3, g: vec3, c: real, s: real, base: BaseFactors, leg: LegFactors
) -> FrameMotion:
    """Return the motion of a leg's housing; rate [rad/s]: of its lateral motor, c, s: cosine and sine of its turn."""
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
    """Return the virtual power [W] of friction, damping, pressed stops and the motors' inertia."""
    passive = joint_forces(joints, loop, front, rates, stop_rates, leg.pressed, dt)
    implicit = passive.inertia * leg.acc + wp.cw_mul(joints.armature, leg.acc)
    return wp.dot(leg.virtual_rates, passive.torque - implicit)


@wp.func
def contact_action(
    geo: LegGeometry, ground: Ground, mu: real, pos: vec3, orientation: quat, paw: PawKinematics, base: BaseFactors,
    leg: LegFactors, dt: real,
) -> real:  # fmt: skip
    """Return the part of a paw's contact: its impulse's virtual power, its weighed law, and the weighed impulse."""
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
    """Return a leg's part of the weighed equations, its paw's contact included, motor torques left out.

    pos, orientation: of the base. omega: its angular velocity [rad/s], g: gravity [m/s^2], both in body axes.
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
    """Weights of what else depends on the base's orientation and velocity."""

    velocity: vec3  # of its linear velocity at the start of the step, body axes
    new_velocity: vec3  # of its linear velocity at the end of the step, world axes
    gravity: vec3  # of gravity in body axes


@wp.func
def base_action(
    body: MassMoments, com: vec3, gravity: vec3, force: vec3, moment: vec3, orientation: quat, lin: vec3, omega: vec3,
    base: BaseFactors, cotangent: BaseCotangent, dt: real,
) -> real:  # fmt: skip
    """Return the base link's part of the weighed equations, and what else depends on its orientation and velocity.

    gravity [m/s^2], force [N], moment [N m] at the com, lin [m/s]: world axes; omega [rad/s]: body axes.
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
    """Return the weighed orientation after dt [s] at an angular velocity [rad/s], body axes."""
    return wp.dot(cotangent, wp.normalize(orientation * exp_rotation(dt * ang)))
