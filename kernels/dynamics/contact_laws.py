"""The paws' contact laws at a solution, their derivatives, and the linear system of their multipliers."""

import warp as wp

from ..scalar import mat33, real, vec3
from ..state import BaseState
from ..terrain.ground import floor_normal
from .base_dynamics import BaseInverse, LegSolve
from .contact import SEPARATE, SLIDE, PawContact, contact_jacobian, contact_mode, couple_contact
from .leg_dynamics import PawKinematics
from .step import Robot, friction_row

wp.set_module_options({"enable_backward": False})


@wp.struct
class PawLaw:
    """A paw's contact law at the solution: its derivatives by velocity and impulse, 0 where separated."""

    mode: int  # SEPARATE, STICK or SLIDE
    mu_row: int  # row of the friction coefficient in the parameter table
    mu: real
    by_velocity: mat33
    by_impulse: mat33  # at fixed velocity


@wp.func
def contact_at(
    robot: Robot, k: int, base: BaseState, paw: PawKinematics, leg: LegSolve, inverse: BaseInverse, impulse: vec3
) -> PawContact:
    """Return paw k's response to impulses; impulse [N s]: in body axes."""
    contact = PawContact()
    contact.active = 1
    contact.impulse = impulse
    centre = base.pos + wp.quat_rotate(base.quat, paw.position)
    contact.normal = wp.quat_rotate_inv(base.quat, floor_normal(robot.ground, centre))
    arm = -robot.geometry[k].paw_radius * contact.normal
    contact.jacobian = contact_jacobian(paw, arm)
    return couple_contact(contact, paw.position + arm, leg, inverse)


@wp.func
def contact_point(robot: Robot, k: int, paw: PawKinematics, contact: PawContact) -> vec3:
    """Return where paw k touches [m], body axes, from the base's origin."""
    return paw.position - robot.geometry[k].paw_radius * contact.normal


@wp.func
def paw_law(
    robot: Robot, world: int, k: int, contact: PawContact, before: vec3, velocity: vec3, old_impulse: vec3
) -> PawLaw:
    """Return the contact law of paw k.

    before, velocity [m/s]: of the contact point at the start and the end of the step; old_impulse [N s]: of the step
    before; body axes.
    """
    law = PawLaw()
    p, n = contact.impulse, contact.normal
    law.mu_row = friction_row(k, before, old_impulse, n)
    law.mu = robot.table[law.mu_row, world]
    law.mode = contact_mode(p, n, law.mu)
    if law.mode == SEPARATE:
        return law
    eye = wp.identity(n=3, dtype=real)
    law.by_velocity = eye
    if law.mode == SLIDE:
        flat = eye - wp.outer(n, n)
        tangential = flat * velocity
        size = wp.dot(p, n)
        law.by_velocity = wp.outer(n, n) + wp.outer(flat * p, wp.normalize(tangential)) + law.mu * size * flat
        law.by_impulse = wp.length(tangential) * flat + law.mu * wp.outer(tangential, n)
    return law


@wp.func
def solve_linear(a: wp.array2d(dtype=real), b: wp.array(dtype=real), n: int):
    """Replace the first n of b by the solution x of a x = b; Gaussian elimination with row pivots, a is overwritten."""
    for col in range(n):
        best = col
        for row in range(col + 1, n):
            if wp.abs(a[row, col]) > wp.abs(a[best, col]):
                best = row
        if best != col:
            for i in range(col, n):
                swap = a[col, i]
                a[col, i] = a[best, i]
                a[best, i] = swap
            swap_b = b[col]
            b[col] = b[best]
            b[best] = swap_b
        scale = real(1.0) / a[col, col]
        for row in range(col + 1, n):
            factor = scale * a[row, col]
            if factor != real(0.0):
                for i in range(col + 1, n):
                    a[row, i] = a[row, i] - factor * a[col, i]
                b[row] = b[row] - factor * b[col]
    for back in range(n):
        row = n - 1 - back
        total = b[row]
        for i in range(row + 1, n):
            total -= a[row, i] * b[i]
        b[row] = total / a[row, row]


@wp.func
def solve_laws(
    contacts: wp.array(dtype=PawContact), laws: wp.array(dtype=PawLaw), seeds: wp.array(dtype=vec3),
    matrix: wp.array2d(dtype=real), vector: wp.array(dtype=real),
):  # fmt: skip
    """Replace the gradients of the paws' impulses in `seeds` by the multipliers of their laws; shapes (4,).

    matrix, vector: of shape (12, 12) and (12,), overwritten.
    """
    row = int(0)
    for k in range(seeds.shape[0]):
        if laws[k].mode != SEPARATE:
            col = int(0)
            for j in range(seeds.shape[0]):
                if laws[j].mode != SEPARATE:
                    block = contacts[k].from_lin * contacts[j].to_lin + contacts[k].from_ang * contacts[j].to_ang
                    if k == j:
                        block = contacts[k].total
                    block = block * wp.transpose(laws[j].by_velocity)
                    if k == j:
                        block = block + wp.transpose(laws[k].by_impulse)
                    for r in range(3):
                        for s in range(3):
                            matrix[row + r, col + s] = block[r, s]
                    col += 3
            for r in range(3):
                vector[row + r] = -seeds[k][r]
            row += 3
    solve_linear(matrix, vector, row)
    row = int(0)
    for k in range(seeds.shape[0]):
        seeds[k] = vec3(real(0.0))
        if laws[k].mode != SEPARATE:
            seeds[k] = vec3(vector[row], vector[row + 1], vector[row + 2])
            row += 3
