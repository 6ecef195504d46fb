"""The same time step as `advance`, cut into kernels that Warp's tape can run backwards.

    legs -> velocities (a) -> contact residual | implicit solve | velocities (b) -> integration

The pressed hard stops and the contact impulses p come from `world_step`, which is not differentiated. Pressed stops
are part of the legs (`joint_forces`), differentiated with their set held. The impulses solve
R(p, x) = 0 (see `contact_residual`), so with the contact modes (separated, sticking, sliding) held,
dp/dx = -(dR/dp)^-1 dR/dx: going backwards, `implicit_kernel` turns the gradient of p that (b) left behind into the
gradient of R, and the adjoints of the residual and of (a) carry it on to x. Where a mode or a set changes the solution
has a kink; the gradient is that of the mode the forward pass found.
"""

import warp as wp

from ...actuation.joint_forces import joint_forces
from ...actuation.springs import spring_torque
from ...actuation.stops import stop_rows
from ...kinematics.geometry import LegGeometry
from ...layout import BASE, BODIES, DOFS, GRAVITY
from ...scalar import mat33, real, vec3
from ...state import base_com, leg_coord, leg_dof, load_base, load_motors, store_base, store_motors
from ...terrain.ground import Ground, floor_distance, floor_normal
from ..base_dynamics import (
    BaseInverse,
    BaseSystem,
    LegSolve,
    base_alone,
    eliminate_leg,
    invert,
    motor_acceleration,
    solve_ang,
    solve_lin,
)
from ..base_motion import external_wrench, moved_base
from ..contact import SEPARATE, SLIDE, contact_jacobian, target_normal_velocity
from ..inertia import inertia_matrix, skew
from ..leg_dynamics import PawKinematics, leg_dynamics, leg_pose, paw_kinematics
from ..parameters import load_joint_params, load_masses, load_moments, load_spring, load_stops, load_vec3


@wp.struct
class LegArrays:
    """What the legs contribute, arrays of shape (4, num_worlds); fields as in `LegSolve`, `BaseSystem`, ..."""

    inverse: wp.array2d(dtype=mat33)
    free: wp.array2d(dtype=vec3)
    to_lin: wp.array2d(dtype=mat33)
    to_ang: wp.array2d(dtype=mat33)
    lin: wp.array2d(dtype=mat33)
    cross: wp.array2d(dtype=mat33)
    ang: wp.array2d(dtype=mat33)
    force: wp.array2d(dtype=vec3)
    moment: wp.array2d(dtype=vec3)
    position: wp.array2d(dtype=vec3)
    jacobian: wp.array2d(dtype=mat33)
    spin: wp.array2d(dtype=mat33)


@wp.struct
class BaseArrays:
    """The base's equations, arrays of shape (num_worlds,): inverse blocks and free accelerations, body axes."""

    lin: wp.array(dtype=mat33)
    cross: wp.array(dtype=mat33)
    ang: wp.array(dtype=mat33)
    lin_acc: wp.array(dtype=vec3)
    ang_acc: wp.array(dtype=vec3)


@wp.struct
class Velocities:
    """Velocities at the end of the step: base twist in the old body axes (num_worlds,), motor rates (4, num_worlds)."""

    lin: wp.array(dtype=vec3)
    ang: wp.array(dtype=vec3)
    rates: wp.array2d(dtype=vec3)


@wp.func
def load_solve(legs: LegArrays, k: int, world: int) -> LegSolve:
    """Return leg k's elimination."""
    solve = LegSolve()
    solve.inverse = legs.inverse[k, world]
    solve.free = legs.free[k, world]
    solve.to_lin = legs.to_lin[k, world]
    solve.to_ang = legs.to_ang[k, world]
    return solve


@wp.func
def load_paw(legs: LegArrays, k: int, world: int) -> PawKinematics:
    """Return paw k's kinematics."""
    paw = PawKinematics()
    paw.position = legs.position[k, world]
    paw.jacobian = legs.jacobian[k, world]
    paw.spin = legs.spin[k, world]
    return paw


@wp.func
def load_inverse(base: BaseArrays, world: int) -> BaseInverse:
    """Return the inverse of the base's system."""
    inverse = BaseInverse()
    inverse.lin = base.lin[world]
    inverse.cross = base.cross[world]
    inverse.ang = base.ang[world]
    return inverse


@wp.kernel
def legs_kernel(
    # in
    geometry: wp.array(dtype=LegGeometry),
    table: wp.array2d(dtype=real),
    joint_q: wp.array(dtype=real),
    joint_qd: wp.array(dtype=real),
    joint_f: wp.array(dtype=real),
    pressed: wp.array2d(dtype=int),
    dt: real,
    # out
    legs: LegArrays,
):
    """Eliminate every leg with its pressed stops, (4, num_worlds); one thread per (leg, world)."""
    k, world = wp.tid()
    geo = geometry[k]
    base = load_base(joint_q, joint_qd, base_com(table, world), world)
    angles = load_motors(joint_q, leg_coord(world, k))
    rates = load_motors(joint_qd, leg_dof(world, k))
    g = wp.quat_rotate_inv(base.quat, load_vec3(table, GRAVITY, world))
    pose = leg_pose(geo, angles)
    leg = leg_dynamics(geo, load_masses(table, k, world), pose, rates, base.ang, g)
    params = load_joint_params(table, k, world)
    rows = stop_rows(load_stops(table, k, world), angles, dt)
    passive = joint_forces(params, pose.loop, geo.front, rates, rows, pressed[k, world], dt)
    torque = load_motors(joint_f, leg_dof(world, k)) + passive.torque
    spring = load_spring(table, k, world)
    if spring.stiffness != real(0.0):
        torque += spring_torque(spring, pose.loop)
    solve = eliminate_leg(leg, passive.inertia + wp.diag(params.armature), torque)
    paw = paw_kinematics(geo, pose)
    legs.inverse[k, world] = solve.inverse
    legs.free[k, world] = solve.free
    legs.to_lin[k, world] = solve.to_lin
    legs.to_ang[k, world] = solve.to_ang
    legs.lin[k, world] = wp.diag(vec3(leg.body.mass)) - leg.coupling_lin * solve.to_lin
    legs.cross[k, world] = -skew(leg.body.first) - leg.coupling_lin * solve.to_ang
    legs.ang[k, world] = inertia_matrix(leg.body.second) - leg.coupling_ang * solve.to_ang
    legs.force[k, world] = -leg.bias_force - leg.coupling_lin * solve.free
    legs.moment[k, world] = -leg.bias_moment - leg.coupling_ang * solve.free
    legs.position[k, world] = paw.position
    legs.jacobian[k, world] = paw.jacobian
    legs.spin[k, world] = paw.spin


@wp.struct
class BaseLoad:
    """What acts on the base from outside, at its com, world axes."""

    force: vec3  # [N]
    moment: vec3  # [N m]


@wp.func
def base_load(
    joint_f: wp.array(dtype=real), body_f: wp.array(dtype=wp.spatial_vector), world: int
) -> BaseLoad:  # fmt: skip
    """Return the sum of the base's joint forces and the wrench on its body."""
    w = body_f[world * BODIES]
    i = world * DOFS
    load = BaseLoad()
    load.force = vec3(real(w[0]) + joint_f[i], real(w[1]) + joint_f[i + 1], real(w[2]) + joint_f[i + 2])
    load.moment = vec3(real(w[3]) + joint_f[i + 3], real(w[4]) + joint_f[i + 4], real(w[5]) + joint_f[i + 5])
    return load


@wp.kernel
def base_kernel(
    # in
    table: wp.array2d(dtype=real),
    joint_q: wp.array(dtype=real),
    joint_qd: wp.array(dtype=real),
    joint_f: wp.array(dtype=real),
    body_f: wp.array(dtype=wp.spatial_vector),
    legs: LegArrays,
    # out
    out: BaseArrays,
):
    """Sum the base's equations and solve them without contact; one thread per world."""
    world = wp.tid()
    com = base_com(table, world)
    base = load_base(joint_q, joint_qd, com, world)
    g = wp.quat_rotate_inv(base.quat, load_vec3(table, GRAVITY, world))
    outside = base_load(joint_f, body_f, world)
    wrench = external_wrench(base, com, outside.force, outside.moment)
    alone = base_alone(load_moments(table, BASE, world), base.ang, g, wrench.force, wrench.moment)
    system = BaseSystem()
    system.lin = alone.lin + legs.lin[0, world] + legs.lin[1, world] + legs.lin[2, world] + legs.lin[3, world]
    system.cross = (
        alone.cross + legs.cross[0, world] + legs.cross[1, world] + legs.cross[2, world] + legs.cross[3, world]
    )
    system.ang = alone.ang + legs.ang[0, world] + legs.ang[1, world] + legs.ang[2, world] + legs.ang[3, world]
    system.force = (
        alone.force + legs.force[0, world] + legs.force[1, world] + legs.force[2, world] + legs.force[3, world]
    )
    system.moment = (
        alone.moment + legs.moment[0, world] + legs.moment[1, world] + legs.moment[2, world] + legs.moment[3, world]
    )
    inverse = invert(system)
    out.lin[world] = inverse.lin
    out.cross[world] = inverse.cross
    out.ang[world] = inverse.ang
    out.lin_acc[world] = solve_lin(inverse, system.force, system.moment)
    out.ang_acc[world] = solve_ang(inverse, system.force, system.moment)


@wp.struct
class PawPush:
    """What an impulse on a paw does to the base's equations: force and moment impulses, motors eliminated."""

    force: vec3
    moment: vec3


@wp.func
def contact_arm(geo: LegGeometry, ground: Ground, centre: vec3) -> vec3:
    """Return the vector [m] from a paw's centre to its contact point, world frame."""
    return -geo.paw_radius * floor_normal(ground, centre)


@wp.func
def paw_push(paw: PawKinematics, solve: LegSolve, arm: vec3, impulse: vec3) -> PawPush:
    """Return the base's share of an impulse [N s] on the paw's contact point; all in body axes."""
    joint = wp.transpose(contact_jacobian(paw, arm)) * impulse
    push = PawPush()
    push.force = impulse - wp.transpose(solve.to_lin) * joint
    push.moment = wp.cross(paw.position + arm, impulse) - wp.transpose(solve.to_ang) * joint
    return push


@wp.kernel
def velocity_kernel(
    # in
    geometry: wp.array(dtype=LegGeometry),
    ground: Ground,
    table: wp.array2d(dtype=real),
    joint_q: wp.array(dtype=real),
    joint_qd: wp.array(dtype=real),
    legs: LegArrays,
    base_eqs: BaseArrays,
    impulse: wp.array2d(dtype=vec3),
    dt: real,
    # out
    out: Velocities,
):
    """Velocities at the end of the step for given paw impulses [N s], body axes; one thread per world."""
    world = wp.tid()
    base = load_base(joint_q, joint_qd, base_com(table, world), world)
    inverse = load_inverse(base_eqs, world)
    force = vec3(real(0.0))
    moment = vec3(real(0.0))
    for k in range(4):
        paw = load_paw(legs, k, world)
        centre = base.pos + wp.quat_rotate(base.quat, paw.position)
        arm = wp.quat_rotate_inv(base.quat, contact_arm(geometry[k], ground, centre))
        push = paw_push(paw, load_solve(legs, k, world), arm, impulse[k, world])
        force += push.force
        moment += push.moment
    lin = solve_lin(inverse, force, moment)
    ang = solve_ang(inverse, force, moment)
    lin_acc = base_eqs.lin_acc[world]
    ang_acc = base_eqs.ang_acc[world]
    out.lin[world] = wp.quat_rotate_inv(base.quat, base.lin) + dt * lin_acc + lin
    out.ang[world] = base.ang + dt * ang_acc + ang
    for k in range(4):
        paw = load_paw(legs, k, world)
        solve = load_solve(legs, k, world)
        centre = base.pos + wp.quat_rotate(base.quat, paw.position)
        arm = wp.quat_rotate_inv(base.quat, contact_arm(geometry[k], ground, centre))
        joint = solve.inverse * (wp.transpose(contact_jacobian(paw, arm)) * impulse[k, world])
        accel = motor_acceleration(solve, lin_acc, ang_acc)
        out.rates[k, world] = (
            load_motors(joint_qd, leg_dof(world, k)) + dt * accel + joint - solve.to_lin * lin - solve.to_ang * ang
        )


@wp.func
def contact_residual(impulse: vec3, velocity: vec3, normal: vec3, goal: real, mu: real, mode: int) -> vec3:
    """Return R, zero where an impulse [N s] and a contact velocity [m/s] satisfy the law of a mode.

    Separated: R = p. Sticking: R = v - goal n. Sliding: normal part v_n - goal, tangential part
    |v_t| p_t + mu p_n v_t.
    """
    if mode == SEPARATE:
        return impulse
    normal_velocity = wp.dot(velocity, normal)
    tangential = velocity - normal_velocity * normal
    if mode == SLIDE:
        size = wp.dot(impulse, normal)
        friction = impulse - size * normal
        return (normal_velocity - goal) * normal + wp.length(tangential) * friction + mu * size * tangential
    return velocity - goal * normal


@wp.kernel
def residual_kernel(
    # in
    geometry: wp.array(dtype=LegGeometry),
    ground: Ground,
    table: wp.array2d(dtype=real),
    joint_q: wp.array(dtype=real),
    joint_qd: wp.array(dtype=real),
    legs: LegArrays,
    velocities: Velocities,
    impulse: wp.array2d(dtype=vec3),
    mode: wp.array2d(dtype=int),
    mu_row: wp.array2d(dtype=int),
    pressed: wp.array2d(dtype=int),
    dt: real,
    # out
    residual: wp.array2d(dtype=vec3),
):
    """Residual of the contact law of every paw; one thread per (leg, world)."""
    k, world = wp.tid()
    base = load_base(joint_q, joint_qd, base_com(table, world), world)
    paw = load_paw(legs, k, world)
    centre = base.pos + wp.quat_rotate(base.quat, paw.position)
    gap = floor_distance(ground, centre) - geometry[k].paw_radius
    normal = wp.quat_rotate_inv(base.quat, floor_normal(ground, centre))
    arm = wp.quat_rotate_inv(base.quat, contact_arm(geometry[k], ground, centre))
    velocity = (
        velocities.lin[world]
        + wp.cross(velocities.ang[world], paw.position + arm)
        + contact_jacobian(paw, arm) * velocities.rates[k, world]
    )
    mu = table[mu_row[k, world], world]
    goal = target_normal_velocity(gap, pressed[k, world], dt)
    residual[k, world] = contact_residual(impulse[k, world], velocity, normal, goal, mu, mode[k, world])


@wp.kernel
def integrate_kernel(
    # in
    table: wp.array2d(dtype=real),
    joint_q: wp.array(dtype=real),
    joint_qd: wp.array(dtype=real),
    velocities: Velocities,
    dt: real,
    # out
    joint_q_out: wp.array(dtype=real),
    joint_qd_out: wp.array(dtype=real),
):
    """Move the coordinates with the velocities at the end of the step; one thread per world."""
    world = wp.tid()
    com = base_com(table, world)
    base = load_base(joint_q, joint_qd, com, world)
    moved = moved_base(base, velocities.lin[world], velocities.ang[world], dt)
    store_base(joint_q_out, joint_qd_out, com, world, moved)
    for k in range(4):
        rates = velocities.rates[k, world]
        angles = load_motors(joint_q, leg_coord(world, k)) + dt * rates
        store_motors(joint_q_out, leg_coord(world, k), angles)
        store_motors(joint_qd_out, leg_dof(world, k), rates)
