"""Solution of the equations of motion, a block arrowhead system: eliminate legs, solve for the base, substitute back.

Legs interact through the base alone. With the base's linear and angular acceleration a, alpha, a leg's motor
accelerations q'' (lateral, outer, inner) and torques tau, and its inertia D, couplings Bv, Bw and bias torques h,

    D q'' + Bv^T a + Bw^T alpha + h = tau      gives      q'' = D^-1 (tau - h) - D^-1 Bv^T a - D^-1 Bw^T alpha,

which turns the equations of base and four legs (18) into six for the base: small fixed-size matrices, no large system.
All vectors are in body axes, about the base origin. See `leg_dynamics` for the terms.
"""

import warp as wp

from ..lanes import sum_matrix, sum_symmetric, sum_vec
from ..scalar import mat33, vec3
from .inertia import MassMoments, inertia_matrix, inertia_mul, inverse_symmetric, skew
from .leg_dynamics import LegDynamics


@wp.struct
class LegSolve:
    """A leg's motor accelerations as a linear function of the base's acceleration.

    q'' = free - to_lin a - to_ang alpha; rows are lateral, outer, inner.
    """

    inverse: mat33  # inverse of D, implicit terms included [1/(kg m^2)]
    free: vec3  # D^-1 (tau - h) [rad/s^2]
    to_lin: mat33  # D^-1 Bv^T [1/m]
    to_ang: mat33  # D^-1 Bw^T [1]


@wp.struct
class BaseSystem:
    """The base's six equations of motion, in 3x3 blocks: [lin cross; cross^T ang] [a; alpha] = [force; moment]."""

    lin: mat33  # [kg]
    cross: mat33  # [kg m]
    ang: mat33  # [kg m^2]
    force: vec3  # [N]
    moment: vec3  # [N m] about the base's origin


@wp.struct
class BaseInverse:
    """Inverse of the 6x6 matrix of the base's equations of motion (`BaseSystem`), in the same 3x3 blocks."""

    lin: mat33  # [1/kg]
    cross: mat33  # [1/(kg m)]
    ang: mat33  # [1/(kg m^2)]


@wp.func
def eliminate_leg(leg: LegDynamics, implicit: mat33, torque: vec3) -> LegSolve:
    """Solve a leg's equations of motion for its motor accelerations, as a linear function of the base's acceleration.

    implicit: matrix added to D [kg m^2], of armature and of forces that are implicit in time; torque: tau [N m], motor
    space.
    """
    solve = LegSolve()
    inverse = inverse_symmetric(leg.inertia + implicit)
    solve.inverse = inverse
    solve.free = inverse * (torque - leg.bias_torque)
    solve.to_lin = inverse * wp.transpose(leg.coupling_lin)
    solve.to_ang = inverse * wp.transpose(leg.coupling_ang)
    return solve


@wp.func
def base_link_system(body: MassMoments, omega: vec3, g: vec3, force: vec3, moment: vec3) -> BaseSystem:
    """Return the equations of motion of the base link alone, without the legs.

    omega: angular velocity [rad/s]; g: gravity [m/s^2]; force [N], moment [N m] about the origin: external; all in body
    axes. force and moment of the result are all that accelerates the base: external, weight, and minus the
    velocity-product (gyroscopic) terms.
    """
    system = BaseSystem()
    system.lin = wp.diag(vec3(body.mass))
    system.cross = -skew(body.first)
    system.ang = inertia_matrix(body.second)
    system.force = force + body.mass * g - wp.cross(omega, wp.cross(omega, body.first))
    system.moment = moment + wp.cross(body.first, g) - wp.cross(omega, inertia_mul(body.second, omega))
    return system


@wp.func
def add_leg(system: BaseSystem, leg: LegDynamics, solve: LegSolve) -> BaseSystem:
    """Return the base's equations of motion (`system`) plus the terms of one leg, its motors eliminated (`solve`).

    At fixed motor angles the leg adds its mass and inertia to the base. Its motors yield: replacing q'' in the leg's
    force on the base, Bv q'' + bias, subtracts Bv D^-1 Bv^T (a Schur complement) from the inertia, and moves the leg's
    forces, bias and Bv D^-1 (tau - h), to the right side with a minus sign.
    """
    s = BaseSystem()
    s.lin = system.lin + wp.diag(vec3(leg.body.mass)) - leg.coupling_lin * solve.to_lin
    s.cross = system.cross - skew(leg.body.first) - leg.coupling_lin * solve.to_ang
    s.ang = system.ang + inertia_matrix(leg.body.second) - leg.coupling_ang * solve.to_ang
    s.force = system.force - leg.bias_force - leg.coupling_lin * solve.free
    s.moment = system.moment - leg.bias_moment - leg.coupling_ang * solve.free
    return s


@wp.func
def invert(system: BaseSystem) -> BaseInverse:
    """Return the inverse of the base's equations (a symmetric positive definite 6x6 matrix) by block elimination."""
    lin_inv = inverse_symmetric(system.lin)
    across = lin_inv * system.cross
    inverse = BaseInverse()
    ang = inverse_symmetric(system.ang - wp.transpose(system.cross) * across)
    cross = -across * ang
    inverse.ang = ang
    inverse.cross = cross
    inverse.lin = lin_inv - cross * wp.transpose(across)
    return inverse


@wp.func
def solve_lin(inverse: BaseInverse, force: vec3, moment: vec3) -> vec3:
    """Return the base's linear acceleration [m/s^2] under a force [N] and moment [N m].

    With impulses in place of force and moment, the result is a velocity [m/s].
    """
    return inverse.lin * force + inverse.cross * moment


@wp.func
def solve_ang(inverse: BaseInverse, force: vec3, moment: vec3) -> vec3:
    """Return the base's angular acceleration [rad/s^2] under a force [N] and moment [N m].

    With impulses in place of force and moment, the result is a velocity [rad/s].
    """
    return wp.transpose(inverse.cross) * force + inverse.ang * moment


@wp.func
def motor_acceleration(solve: LegSolve, lin: vec3, ang: vec3) -> vec3:
    """Return the motor accelerations [rad/s^2] of a leg for base accelerations [m/s^2], [rad/s^2] in body axes.

    The function substitutes the solution for the base into the eliminated equations of the leg.
    """
    return solve.free - solve.to_lin * lin - solve.to_ang * ang


@wp.func
def sum_systems(base: BaseSystem, leg: BaseSystem) -> BaseSystem:
    """Sum the base's equations of motion and the legs' terms, each from its own thread, over a world's four threads.

    The result is `base` plus the sum of `leg`.
    """
    s = BaseSystem()
    s.lin = base.lin + sum_symmetric(leg.lin)
    s.cross = base.cross + sum_matrix(leg.cross)
    s.ang = base.ang + sum_symmetric(leg.ang)
    s.force = base.force + sum_vec(leg.force)
    s.moment = base.moment + sum_vec(leg.moment)
    return s
