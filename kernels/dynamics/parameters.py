"""Robot parameters of all worlds in a table: functions that read it, and kernels that fill it from Newton's model.

The physics kernels read the table instead of Newton's arrays: it holds the form that the equations use (moments about a
link's frame instead of mass, com and inertia), in an order in which neighbouring GPU threads read neighbouring numbers.
The table is (PARAMETER_ROWS, num_worlds), see `layout`. `load_*` return structs for leg 0 to 3 (FL, FR, BL, BR) of a
world, in the units of the structs.
"""

import warp as wp

from .. import layout
from ..actuation.joint_forces import JointParams
from ..actuation.springs import LegSpring
from ..actuation.stops import StopParams
from ..scalar import real, vec3, vec6
from .inertia import MassMoments
from .leg_dynamics import LegMasses

wp.set_module_options({"enable_backward": False})


@wp.func
def load_vec3(table: wp.array2d(dtype=real), row: int, world: int) -> vec3:
    """Return three consecutive parameters of a world as a vector: rows of the parameter table, from `row` on."""
    return vec3(table[row, world], table[row + 1, world], table[row + 2, world])


@wp.func
def load_moments(table: wp.array2d(dtype=real), row: int, world: int) -> MassMoments:
    """Return the mass moments of a link of a world from the parameter table, MOMENT_ROWS rows from `row` on."""
    m = MassMoments()
    m.mass = table[row, world]
    m.first = load_vec3(table, row + 1, world)
    m.second = vec6(
        table[row + 4, world], table[row + 5, world], table[row + 6, world],
        table[row + 7, world], table[row + 8, world], table[row + 9, world],
    )  # fmt: skip
    return m


@wp.func
def load_masses(table: wp.array2d(dtype=real), leg: int, world: int) -> LegMasses:
    """Return the mass moments of a leg's five links, each in its own link frame."""
    row = leg * layout.LEG_ROWS
    masses = LegMasses()
    masses.housing = load_moments(table, row + layout.HOUSING, world)
    masses.outer_thigh = load_moments(table, row + layout.OUTER_THIGH, world)
    masses.outer_shank = load_moments(table, row + layout.OUTER_SHANK, world)
    masses.inner_thigh = load_moments(table, row + layout.INNER_THIGH, world)
    masses.inner_shank = load_moments(table, row + layout.INNER_SHANK, world)
    return masses


@wp.func
def load_stops(table: wp.array2d(dtype=real), leg: int, world: int) -> StopParams:
    """Return the constants of the hard stops of a leg from the parameter table."""
    row = leg * layout.LEG_ROWS
    p = StopParams()
    p.lower = load_vec3(table, row + layout.LOWER, world)
    p.upper = load_vec3(table, row + layout.UPPER, world)
    p.sum_lower = table[row + layout.SUM_LOWER, world]
    p.sum_upper = table[row + layout.SUM_UPPER, world]
    p.ke = table[row + layout.STOP_KE, world]
    p.kd = table[row + layout.STOP_KD, world]
    return p


@wp.func
def load_joint_params(table: wp.array2d(dtype=real), leg: int, world: int) -> JointParams:
    """Return armature, friction and damping of a leg's motors and knees."""
    row = leg * layout.LEG_ROWS
    p = JointParams()
    p.armature = load_vec3(table, row + layout.ARMATURE, world)
    p.friction = load_vec3(table, row + layout.FRICTION, world)
    p.damping = load_vec3(table, row + layout.DAMPING, world)
    p.knee_damping_outer = table[row + layout.KNEE_DAMPING, world]
    p.knee_damping_inner = table[row + layout.KNEE_DAMPING + 1, world]
    p.knee_limit_outer = table[row + layout.KNEE_LIMIT, world]
    p.knee_limit_inner = table[row + layout.KNEE_LIMIT + 1, world]
    return p


@wp.func
def load_spring(table: wp.array2d(dtype=real), leg: int, world: int) -> LegSpring:
    """Return the constants of the spring between the knees of a leg from the parameter table."""
    row = leg * layout.LEG_ROWS + layout.SPRING
    spring = LegSpring()
    spring.stiffness = table[row, world]
    spring.length = table[row + 1, world]
    return spring


@wp.func
def store_link(table: wp.array2d(dtype=real), row: int, world: int, mass: float, com: wp.vec3, inertia: wp.mat33):
    """Write a link's mass moments about its frame's origin to the parameter table.

    From mass [kg], com c [m] and inertia I at the com [kg m^2]; rows from `row` on. The second moments are
    S = trace(I) / 2 - I + mass c c^T.
    """
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
    """Return the row of the parameter table where a body's mass moments begin; body: 0 (base) to 20."""
    if body == 0:
        return layout.BASE
    return ((body - 1) // layout.LEG_BODIES) * layout.LEG_ROWS + ((body - 1) % layout.LEG_BODIES) * layout.MOMENT_ROWS


@wp.func
def motor_dof(leg: int, motor: int) -> int:
    """Return the index of a motor among the 38 joint rates of its world; motor: 0 lateral, 1 outer, 2 inner."""
    return 6 + layout.motor_slot(3 * leg + motor)


@wp.kernel
def pack_constants_kernel(
    # in
    damping: wp.array(dtype=float),
    lower: wp.array(dtype=float),
    upper: wp.array(dtype=float),
    limit_ke: wp.array(dtype=float),
    limit_kd: wp.array(dtype=float),
    effort_limit: wp.array(dtype=float),
    sum_lower: float,
    sum_upper: float,
    springs: wp.array(dtype=wp.vec2),
    gravity: wp.array(dtype=wp.vec3),
    # out
    table: wp.array2d(dtype=real),
):
    """Write damping, hard stops and spring of every leg, and gravity, to the parameter table; thread per (world, leg).

    Arrays: Newton's per-dof model arrays, (38 num_worlds,), [rad], [N m] and their rates as in `JointParams` and
    `StopParams`; effort_limit [N m] caps the knees' damping. sum_lower, sum_upper [rad]: stops of outer + inner.
    springs: stiffness [N/m] and rest length [m] of each world. gravity: [m/s^2] of each world, world frame.
    """
    world, leg = wp.tid()
    row = leg * layout.LEG_ROWS
    dof = world * layout.DOFS + 6 + 5 * leg
    for j in range(3):
        i = world * layout.DOFS + motor_dof(leg, j)
        table[row + layout.DAMPING + j, world] = real(damping[i])
        table[row + layout.LOWER + j, world] = real(lower[i])
        table[row + layout.UPPER + j, world] = real(upper[i])
        table[layout.GRAVITY + j, world] = real(gravity[world][j])
    for j in range(2):
        table[row + layout.KNEE_DAMPING + j, world] = real(damping[dof + 2 + 2 * j])
        table[row + layout.KNEE_LIMIT + j, world] = real(effort_limit[dof + 2 + 2 * j])
        table[row + layout.SPRING + j, world] = real(springs[world][j])
    table[row + layout.SUM_LOWER, world] = real(sum_lower)
    table[row + layout.SUM_UPPER, world] = real(sum_upper)
    table[row + layout.STOP_KE, world] = real(limit_ke[dof + 1])
    table[row + layout.STOP_KD, world] = real(limit_kd[dof + 1])


@wp.func
def paw_friction(
    paw_shapes: wp.array(dtype=int), ground_shape: int, shape_mu: wp.array(dtype=float), world: int, leg: int
) -> float:
    """Return the friction coefficient [1] of a paw on the ground: the larger of both surfaces', as in MuJoCo.

    paw_shapes (4 num_worlds,), ground_shape: indices into shape_mu; ground_shape < 0: the paw's coefficient alone.
    """
    mu = shape_mu[paw_shapes[world * 4 + leg]]
    if ground_shape >= 0:
        mu = wp.max(mu, shape_mu[ground_shape])
    return mu


@wp.func
def store_friction(table: wp.array2d(dtype=real), leg: int, world: int, mu: float, static_ratio: float):
    """Write a paw's dynamic and static friction coefficients, mu and mu * static_ratio, to the parameter table."""
    table[leg * layout.LEG_ROWS + layout.MU_DYNAMIC, world] = real(mu)
    table[leg * layout.LEG_ROWS + layout.MU_STATIC, world] = real(mu * static_ratio)


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
    """Copy the parameters that domain randomisation changes to the parameter table, where mask (num_worlds,) is not 0.

    Launch over (worlds from `first` on, 25): threads 0 to 20 of a world write the mass moments of a body each, the
    other four a leg's armature, friction torques and paw friction. Inputs: Newton's model arrays, see `paw_friction`.
    """
    world, part = wp.tid()
    world += first
    if mask[world] == 0.0:
        return
    if part < layout.BODIES:
        i = world * layout.BODIES + part
        store_link(table, body_row(part), world, body_mass[i], body_com[i], body_inertia[i])
        return
    leg = part - layout.BODIES
    for j in range(3):
        dof = world * layout.DOFS + motor_dof(leg, j)
        table[leg * layout.LEG_ROWS + layout.ARMATURE + j, world] = real(armature[dof])
        table[leg * layout.LEG_ROWS + layout.FRICTION + j, world] = real(friction[dof])
    store_friction(table, leg, world, paw_friction(paw_shapes, ground_shape, shape_mu, world, leg), static_ratio[world])
