"""Contact laws of the paws at the solution of a step, and their derivatives for the reverse pass.

The forward pass solves for impulses p and contact velocities v by iteration. The reverse pass differentiates the
equation R(p, v) = 0 that they satisfy, in the mode that was found: separated, sticking or sliding (`contact_residual`).
Vectors are in body axes; normals n point out of the ground, impulses act on the paw. Paws k are 0 to 3: FL, FR, BL, BR.
"""

import warp as wp

from ..kinematics.geometry import leg_of
from ..scalar import mat33, real, vec3
from ..state import BaseState
from ..terrain.ground import floor_normal
from .base_dynamics import BaseInverse, LegSolve
from .contact import SEPARATE, SLIDE, PawContact, contact_jacobian, contact_mode, couple_contact
from .leg_dynamics import PawKinematics
from .step import RobotModel, friction_row

wp.set_module_options({"enable_backward": False})


@wp.struct
class PawLaw:
    """Contact law of a paw, linearised at the solution of a step: mode, friction and derivatives; body axes.

    R(impulse, velocity) = 0, see `contact_residual`.
    """

    mode: int  # SEPARATE, STICK or SLIDE
    mu_row: int  # row of the friction coefficient in the parameter table
    mu: real  # friction coefficient
    by_velocity: mat33  # dR/dv, a row per component of R; 0 where separated
    by_impulse: mat33  # dR/dp at fixed velocity, a row per component of R; 0 where separated (dR/dp is 1 there)


@wp.func
def contact_at(
    model: RobotModel, world: int, k: int, base: BaseState, paw: PawKinematics, leg: LegSolve, inverse: BaseInverse,
    impulse: vec3,
) -> PawContact:  # fmt: skip
    """Return the contact of paw k with the floor at the solution of a step, with velocity responses to impulses.

    k: 0 to 3. impulse [N s]: body axes. The function recomputes the contact from the state at the start of the step.
    """
    contact = PawContact()
    contact.active = 1
    contact.impulse = impulse
    centre = base.pos + wp.quat_rotate(base.quat, paw.position)
    contact.normal = wp.quat_rotate_inv(base.quat, floor_normal(model.ground, centre))
    arm = -leg_of(model.geometry, world, k).paw_radius * contact.normal
    contact.jacobian = contact_jacobian(paw, arm)
    return couple_contact(contact, paw.position + arm, leg, inverse)


@wp.func
def contact_point(model: RobotModel, world: int, k: int, paw: PawKinematics, contact: PawContact) -> vec3:
    """Return the contact point [m] of paw k (0 to 3) in the body frame."""
    return paw.position - leg_of(model.geometry, world, k).paw_radius * contact.normal


@wp.func
def paw_law(
    model: RobotModel, world: int, k: int, contact: PawContact, old_velocity: vec3, velocity: vec3, old_impulse: vec3
) -> PawLaw:
    """Return the contact law of paw k (0 to 3), linearised at the solution of a step.

    The matrices are the derivatives of `contact_residual` in its mode; SEPARATE needs none, since p = 0. old_velocity,
    velocity [m/s] of the contact point at the start and the end of the step; old_impulse [N s]: in the preceding step;
    all in body axes.
    """
    law = PawLaw()
    p, n = contact.impulse, contact.normal
    law.mu_row = friction_row(k, old_velocity, old_impulse, n)
    law.mu = model.table[law.mu_row, world]
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
def contact_residual(impulse: vec3, velocity: vec3, normal: vec3, goal: real, mu: real, mode: int) -> vec3:
    """Return the residual of a paw's contact law, zero where impulse [N s] and velocity [m/s] satisfy it.

    R by mode: SEPARATE: R = p. STICK: R = v - goal n. SLIDE: normal part v_n - goal, tangential part |v_t| p_t + mu p_n
    v_t. goal [m/s]: see `PawContact`.
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
