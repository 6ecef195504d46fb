"""The solution of contacts and stops for the differentiable step, and the implicit derivative of contact."""

import warp as wp

from ...actuation.stops import StopRows
from ...scalar import mat33, real, vec3
from ...state import base_com, leg_coord, leg_dof, load_base, load_motors
from ..base_dynamics import LegSolve
from ..contact import SEPARATE, SLIDE, BlockLaw, PawContact, contact_mode
from ..leg_dynamics import PawKinematics
from ..step import Robot, StepSettings, paw_contact
from ..world.world_step import solve_step
from .differentiable import BaseArrays, LegArrays, Velocities, base_load, load_inverse, load_paw, load_solve

wp.set_module_options({"enable_backward": False})


@wp.struct
class Solution:
    """Solved contacts and stops, arrays of shape (4, num_worlds)."""

    impulse: wp.array2d(dtype=vec3)  # [N s], body axes
    mode: wp.array2d(dtype=int)  # SEPARATE, STICK, SLIDE
    mu_row: wp.array2d(dtype=int)  # row of the friction coefficient in the parameter table
    pressed: wp.array2d(dtype=int)  # set of hard stops


@wp.func
def load_contacts(
    robot: Robot, world: int, joint_q: wp.array(dtype=real), joint_qd: wp.array(dtype=real), legs: LegArrays,
    base_eqs: BaseArrays, solution: Solution, dt: real, contacts: wp.array(dtype=PawContact),
):  # fmt: skip
    """Write a solved world's contact problem to `contacts`."""
    base = load_base(joint_q, joint_qd, base_com(robot.table, world), world)
    lin = wp.quat_rotate_inv(base.quat, base.lin) + dt * base_eqs.lin_acc[world]
    ang = base.ang + dt * base_eqs.ang_acc[world]
    inverse = load_inverse(base_eqs, world)
    for k in range(contacts.shape[0]):
        solve = load_solve(legs, k, world)
        old = load_motors(joint_qd, leg_dof(world, k))
        rates = old + dt * (
            solve.free - solve.to_lin * base_eqs.lin_acc[world] - solve.to_ang * base_eqs.ang_acc[world]
        )
        paw = load_paw(legs, k, world)
        contacts[k] = paw_contact(
            robot, world, k, base, lin, ang, rates, old, solution.impulse[k, world], solution.pressed[k, world], paw,
            solve, inverse, BlockLaw(), dt,
        )  # fmt: skip


@wp.kernel
def settle_kernel(
    # in
    robot: Robot,
    settings: StepSettings,
    joint_q: wp.array(dtype=real),
    joint_qd: wp.array(dtype=real),
    joint_f: wp.array(dtype=real),
    body_f: wp.array(dtype=wp.spatial_vector),
    # in, out
    guess: wp.array2d(dtype=vec3),
    # out
    solution: Solution,
    contact_force: wp.array2d(dtype=vec3),
):
    """Solve every world's contacts and stops; `guess` receives the impulses [N s] in the world frame for the next step.

    One thread per world.
    """
    world = wp.tid()
    base = load_base(joint_q, joint_qd, base_com(robot.table, world), world)
    outside = base_load(joint_f, body_f, world)
    angles = wp.zeros(shape=(4,), dtype=vec3)
    rates = wp.zeros(shape=(4,), dtype=vec3)
    torques = wp.zeros(shape=(4,), dtype=vec3)
    for k in range(angles.shape[0]):
        angles[k] = load_motors(joint_q, leg_coord(world, k))
        rates[k] = load_motors(joint_qd, leg_dof(world, k))
        torques[k] = load_motors(joint_f, leg_dof(world, k))
    rows = wp.zeros(shape=(4,), dtype=StopRows)
    pressed = wp.zeros(shape=(4,), dtype=int)
    legs = wp.zeros(shape=(4,), dtype=LegSolve)
    paws = wp.zeros(shape=(4,), dtype=PawKinematics)
    contacts = wp.zeros(shape=(4,), dtype=PawContact)
    ends = wp.zeros(shape=(4,), dtype=vec3)
    solve_step(
        robot, settings, world, base, outside.force, outside.moment, BlockLaw(), guess, angles, rates, torques, rows,
        pressed, legs, paws, contacts, ends,
    )  # fmt: skip
    for k in range(contacts.shape[0]):
        c = contacts[k]
        solution.impulse[k, world] = c.impulse
        solution.mu_row[k, world] = c.mu_row
        solution.mode[k, world] = contact_mode(c.impulse, c.normal, c.mu)
        solution.pressed[k, world] = pressed[k]
        in_world = wp.quat_rotate(base.quat, c.impulse)
        guess[k, world] = in_world
        contact_force[k, world] = in_world / settings.dt


@wp.func
def response(contacts: wp.array(dtype=PawContact), k: int, j: int) -> mat33:
    """Return the velocity of contact k per impulse at contact j [1/kg]."""
    block = contacts[k].from_lin * contacts[j].to_lin + contacts[k].from_ang * contacts[j].to_ang
    if k == j:
        return block + contacts[k].own
    return block


@wp.func
def residual_block(c: PawContact, mode: int, impulse: vec3, velocity: vec3, block: mat33, own: real) -> mat33:
    """Return dR_k/dp_j of `contact_residual` for dv_k/dp_j = block; own: 1 if j is k, else 0."""
    eye = own * wp.identity(n=3, dtype=real)
    if mode == SEPARATE:
        return eye
    if mode != SLIDE:
        return block
    n = c.normal
    normal = wp.outer(n, n)
    flat = wp.identity(n=3, dtype=real) - normal
    tangential = flat * velocity
    speed = wp.length(tangential)
    friction = flat * impulse
    size = wp.dot(impulse, n)
    return (
        normal * block
        + (wp.outer(friction, wp.normalize(tangential)) + c.mu * size * flat) * block
        + speed * flat * eye
        + own * c.mu * wp.outer(tangential, n)
    )


@wp.func
def solve_transposed(a: wp.array2d(dtype=real), b: wp.array(dtype=real)):
    """Replace b by the solution x of a^T x = b; Gaussian elimination with partial pivoting, `a` is overwritten."""
    n = b.shape[0]
    for col in range(n):
        best = col
        for row in range(col + 1, n):
            if wp.abs(a[col, row]) > wp.abs(a[col, best]):
                best = row
        for i in range(n):
            swap = a[i, col]
            a[i, col] = a[i, best]
            a[i, best] = swap
        swap_b = b[col]
        b[col] = b[best]
        b[best] = swap_b
        for row in range(col + 1, n):
            factor = a[col, row] / a[col, col]
            for i in range(col, n):
                a[i, row] = a[i, row] - factor * a[i, col]
            b[row] = b[row] - factor * b[col]
    for back in range(n):
        row = n - 1 - back
        total = b[row]
        for i in range(row + 1, n):
            total -= a[i, row] * b[i]
        b[row] = total / a[row, row]


@wp.kernel
def implicit_kernel(
    # in
    robot: Robot,
    joint_q: wp.array(dtype=real),
    joint_qd: wp.array(dtype=real),
    legs: LegArrays,
    base_eqs: BaseArrays,
    velocities: Velocities,
    solution: Solution,
    dt: real,
    # in, out
    impulse_grad: wp.array2d(dtype=vec3),
    # out
    residual_grad: wp.array2d(dtype=vec3),
):
    """Turn the gradient of the impulses into that of the residual, -(dR/dp)^-T times it, and clear it."""
    world = wp.tid()
    contacts = wp.zeros(shape=(4,), dtype=PawContact)
    load_contacts(robot, world, joint_q, joint_qd, legs, base_eqs, solution, dt, contacts)
    a = wp.zeros(shape=(12, 12), dtype=real)
    b = wp.zeros(shape=(12,), dtype=real)
    for k in range(4):
        mode = solution.mode[k, world]
        c = contacts[k]
        velocity = vec3(real(0.0))
        if mode != SEPARATE:
            c.mu = robot.table[solution.mu_row[k, world], world]
            # velocity of the contact point at the end of the step
            centre = load_paw(legs, k, world).position
            point = centre - robot.geometry[k].paw_radius * c.normal
            velocity = (
                velocities.lin[world] + wp.cross(velocities.ang[world], point) + c.jacobian * velocities.rates[k, world]
            )
        for j in range(4):
            own = real(0.0)
            block = mat33(real(0.0))
            if k == j:
                own = real(1.0)
            if mode != SEPARATE and contacts[j].active != 0:
                block = response(contacts, k, j)
            m = residual_block(c, mode, solution.impulse[k, world], velocity, block, own)
            for r in range(3):
                for s in range(3):
                    a[3 * k + r, 3 * j + s] = m[r, s]
        for r in range(3):
            b[3 * k + r] = impulse_grad[k, world][r]
        impulse_grad[k, world] = vec3(real(0.0))
    solve_transposed(a, b)
    for k in range(4):
        residual_grad[k, world] = -vec3(b[3 * k], b[3 * k + 1], b[3 * k + 2])
