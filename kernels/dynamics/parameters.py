"""Per-world parameters of the robot, packed from a Newton model into the table that `layout` describes."""

import warp as wp

from ..actuation.joint_forces import JointParams
from ..actuation.springs import LegSpring
from ..actuation.stops import StopParams
from ..layout import (
    ARMATURE,
    BASE,
    BODIES,
    DAMPING,
    DOFS,
    FRICTION,
    GRAVITY,
    HOUSING,
    INNER_SHANK,
    INNER_THIGH,
    KNEE_DAMPING,
    KNEE_LIMIT,
    LEG_BODIES,
    LEG_ROWS,
    LOWER,
    MOMENT_ROWS,
    MU_DYNAMIC,
    MU_STATIC,
    OUTER_SHANK,
    OUTER_THIGH,
    SPRING,
    STOP_KD,
    STOP_KE,
    SUM_LOWER,
    SUM_UPPER,
    UPPER,
    motor_slot,
)
from ..scalar import real, vec3, vec6
from .inertia import MassMoments
from .leg_dynamics import LegMasses


@wp.func
def load_vec3(table: wp.array2d(dtype=real), row: int, world: int) -> vec3:
    """Return three consecutive rows as a vector."""
    return vec3(table[row, world], table[row + 1, world], table[row + 2, world])


@wp.func
def load_moments(table: wp.array2d(dtype=real), row: int, world: int) -> MassMoments:
    """Return the mass moments that start at a row."""
    m = MassMoments()
    m.mass = table[row, world]
    m.first = load_vec3(table, row + 1, world)
    m.second = vec6(
        table[row + 4, world],
        table[row + 5, world],
        table[row + 6, world],
        table[row + 7, world],
        table[row + 8, world],
        table[row + 9, world],
    )
    return m


@wp.func
def load_masses(table: wp.array2d(dtype=real), leg: int, world: int) -> LegMasses:
    """Return the mass moments of a leg's links."""
    row = leg * LEG_ROWS
    masses = LegMasses()
    masses.housing = load_moments(table, row + HOUSING, world)
    masses.outer_thigh = load_moments(table, row + OUTER_THIGH, world)
    masses.outer_shank = load_moments(table, row + OUTER_SHANK, world)
    masses.inner_thigh = load_moments(table, row + INNER_THIGH, world)
    masses.inner_shank = load_moments(table, row + INNER_SHANK, world)
    return masses


@wp.func
def load_stops(table: wp.array2d(dtype=real), leg: int, world: int) -> StopParams:
    """Return the hard stops of a leg."""
    row = leg * LEG_ROWS
    p = StopParams()
    p.lower = load_vec3(table, row + LOWER, world)
    p.upper = load_vec3(table, row + UPPER, world)
    p.sum_lower = table[row + SUM_LOWER, world]
    p.sum_upper = table[row + SUM_UPPER, world]
    p.ke = table[row + STOP_KE, world]
    p.kd = table[row + STOP_KD, world]
    return p


@wp.func
def load_joint_params(table: wp.array2d(dtype=real), leg: int, world: int) -> JointParams:
    """Return the joint-space parameters of a leg."""
    row = leg * LEG_ROWS
    p = JointParams()
    p.armature = load_vec3(table, row + ARMATURE, world)
    p.friction = load_vec3(table, row + FRICTION, world)
    p.damping = load_vec3(table, row + DAMPING, world)
    p.knee_damping_outer = table[row + KNEE_DAMPING, world]
    p.knee_damping_inner = table[row + KNEE_DAMPING + 1, world]
    p.knee_limit_outer = table[row + KNEE_LIMIT, world]
    p.knee_limit_inner = table[row + KNEE_LIMIT + 1, world]
    return p


@wp.func
def load_spring(table: wp.array2d(dtype=real), leg: int, world: int) -> LegSpring:
    """Return the spring of a leg."""
    row = leg * LEG_ROWS + SPRING
    spring = LegSpring()
    spring.stiffness = table[row, world]
    spring.length = table[row + 1, world]
    return spring


@wp.func
def store_link(table: wp.array2d(dtype=real), row: int, world: int, mass: float, com: wp.vec3, inertia: wp.mat33):
    """Write a link's mass moments about its own frame, from mass, com [m] and inertia about the com [kg m^2]."""
    half_trace = real(0.5) * (real(inertia[0, 0]) + real(inertia[1, 1]) + real(inertia[2, 2]))
    m = real(mass)
    c = vec3(real(com[0]), real(com[1]), real(com[2]))
    table[row, world] = m
    table[row + 1, world] = m * c[0]
    table[row + 2, world] = m * c[1]
    table[row + 3, world] = m * c[2]
    table[row + 4, world] = half_trace - real(inertia[0, 0]) + m * c[0] * c[0]
    table[row + 5, world] = half_trace - real(inertia[1, 1]) + m * c[1] * c[1]
    table[row + 6, world] = half_trace - real(inertia[2, 2]) + m * c[2] * c[2]
    table[row + 7, world] = m * c[0] * c[1] - real(0.5) * (real(inertia[0, 1]) + real(inertia[1, 0]))
    table[row + 8, world] = m * c[0] * c[2] - real(0.5) * (real(inertia[0, 2]) + real(inertia[2, 0]))
    table[row + 9, world] = m * c[1] * c[2] - real(0.5) * (real(inertia[1, 2]) + real(inertia[2, 1]))


@wp.func
def body_row(body: int) -> int:
    """Return the first row of a body's mass moments."""
    if body == 0:
        return BASE
    return ((body - 1) // LEG_BODIES) * LEG_ROWS + ((body - 1) % LEG_BODIES) * MOMENT_ROWS


@wp.func
def motor_dof(leg: int, motor: int) -> int:
    """Return a motor's place among the rates of its world; motors: lateral, outer, inner."""
    return 6 + motor_slot(3 * leg + motor)


@wp.kernel
def pack_masses_kernel(
    # in
    body_mass: wp.array(dtype=float),
    body_com: wp.array(dtype=wp.vec3),
    body_inertia: wp.array(dtype=wp.mat33),
    # out
    table: wp.array2d(dtype=real),
):
    """Write the mass moments of every body; one thread per (world, body)."""
    world, body = wp.tid()
    i = world * BODIES + body
    store_link(table, body_row(body), world, body_mass[i], body_com[i], body_inertia[i])


@wp.kernel
def pack_joints_kernel(
    # in
    armature: wp.array(dtype=float),
    friction: wp.array(dtype=float),
    damping: wp.array(dtype=float),
    lower: wp.array(dtype=float),
    upper: wp.array(dtype=float),
    limit_ke: wp.array(dtype=float),
    limit_kd: wp.array(dtype=float),
    effort_limit: wp.array(dtype=float),
    sum_lower: float,
    sum_upper: float,
    # out
    table: wp.array2d(dtype=real),
):
    """Write the joint-space parameters of every leg; one thread per (world, leg)."""
    world, leg = wp.tid()
    row = leg * LEG_ROWS
    dof = world * DOFS + 6 + 5 * leg
    for j in range(3):
        i = world * DOFS + motor_dof(leg, j)
        table[row + ARMATURE + j, world] = real(armature[i])
        table[row + FRICTION + j, world] = real(friction[i])
        table[row + DAMPING + j, world] = real(damping[i])
        table[row + LOWER + j, world] = real(lower[i])
        table[row + UPPER + j, world] = real(upper[i])
    table[row + KNEE_DAMPING, world] = real(damping[dof + 2])
    table[row + KNEE_DAMPING + 1, world] = real(damping[dof + 4])
    table[row + KNEE_LIMIT, world] = real(effort_limit[dof + 2])
    table[row + KNEE_LIMIT + 1, world] = real(effort_limit[dof + 4])
    table[row + SUM_LOWER, world] = real(sum_lower)
    table[row + SUM_UPPER, world] = real(sum_upper)
    table[row + STOP_KE, world] = real(limit_ke[dof + 1])
    table[row + STOP_KD, world] = real(limit_kd[dof + 1])


@wp.func
def paw_friction(
    paw_shapes: wp.array(dtype=int), ground_shape: int, shape_mu: wp.array(dtype=float), world: int, leg: int
) -> float:
    """Return a paw's coefficient on the ground: the larger of the two, as in MuJoCo."""
    mu = shape_mu[paw_shapes[world * 4 + leg]]
    if ground_shape >= 0:
        mu = wp.max(mu, shape_mu[ground_shape])
    return mu


@wp.func
def store_friction(table: wp.array2d(dtype=real), leg: int, world: int, mu: float, static_ratio: float):
    """Write a paw's dynamic coefficient and its static one, static_ratio times as large."""
    table[leg * LEG_ROWS + MU_DYNAMIC, world] = real(mu)
    table[leg * LEG_ROWS + MU_STATIC, world] = real(mu * static_ratio)


@wp.kernel
def pack_friction_kernel(
    # in
    paw_shapes: wp.array(dtype=int),
    ground_shape: int,
    shape_mu: wp.array(dtype=float),
    static_ratio: wp.array(dtype=float),
    # out
    table: wp.array2d(dtype=real),
):
    """Write the friction coefficients of every paw; one thread per (world, leg)."""
    world, leg = wp.tid()
    store_friction(table, leg, world, paw_friction(paw_shapes, ground_shape, shape_mu, world, leg), static_ratio[world])


@wp.kernel
def repack_kernel(
    # in
    first: int,
    mask: wp.array(dtype=float),
    body_mass: wp.array(dtype=float),
    body_com: wp.array(dtype=wp.vec3),
    body_inertia: wp.array(dtype=wp.mat33),
    armature: wp.array(dtype=float),
    friction: wp.array(dtype=float),
    paw_shapes: wp.array(dtype=int),
    ground_shape: int,
    shape_mu: wp.array(dtype=float),
    static_ratio: wp.array(dtype=float),
    # out
    table: wp.array2d(dtype=real),
):
    """Write what domain randomisation draws, where mask (num_worlds,) is not 0; launch over (worlds from first on, 25).

    The first 21 threads of a world write a body each, the others a leg's motors and paw.
    """
    world, part = wp.tid()
    world += first
    if mask[world] == 0.0:
        return
    if part < BODIES:
        i = world * BODIES + part
        store_link(table, body_row(part), world, body_mass[i], body_com[i], body_inertia[i])
        return
    leg = part - BODIES
    for j in range(3):
        dof = world * DOFS + motor_dof(leg, j)
        table[leg * LEG_ROWS + ARMATURE + j, world] = real(armature[dof])
        table[leg * LEG_ROWS + FRICTION + j, world] = real(friction[dof])
    store_friction(table, leg, world, paw_friction(paw_shapes, ground_shape, shape_mu, world, leg), static_ratio[world])


@wp.kernel
def pack_springs_kernel(
    # in
    springs: wp.array(dtype=wp.vec2),
    # out
    table: wp.array2d(dtype=real),
):
    """Write stiffness [N/m] and rest length [m] of the springs of every leg; one thread per (world, leg)."""
    world, leg = wp.tid()
    for j in range(2):
        table[leg * LEG_ROWS + SPRING + j, world] = real(springs[world][j])


@wp.kernel
def pack_gravity_kernel(
    # in
    gravity: wp.array(dtype=wp.vec3),
    # out
    table: wp.array2d(dtype=real),
):
    """Write gravity [m/s^2]; one thread per world."""
    world = wp.tid()
    for j in range(3):
        table[GRAVITY + j, world] = real(gravity[world][j])
