"""Passive forces of a leg in motor space, implicit in time: friction, damping and the hard stops that it presses.

Each force is linear in the rates after the step, tau = b - C q'(t + dt), so that it adds dt C to the inertia and
b - C q'(t) to the torque: stiff stops stay stable at any step size. Friction and capped damping are not linear: each is
replaced by the damper that has the same torque at the rates q'(t). Motor space: lateral (positive outward), outer and
inner angle (positive away from the leg's other thigh).
"""

import warp as wp

from ..kinematics.five_bar import FiveBar
from ..scalar import mat33, real, vec3
from .stops import StopRates, stop_forces

# below this rate [rad/s] Coulomb friction falls linearly to zero
FRICTION_SPEED = wp.constant(real(0.01))


@wp.struct
class JointParams:
    """Armature, friction and damping of the joints of one leg; vectors are lateral, outer, inner."""

    armature: vec3  # [kg m^2]
    friction: vec3  # [N m]
    damping: vec3  # [N m s/rad]
    knee_damping_outer: real  # [N m s/rad]
    knee_damping_inner: real
    knee_limit_outer: real  # [N m] largest torque of the knee damping
    knee_limit_inner: real


@wp.struct
class JointForces:
    """Implicit passive forces of a leg in motor space: torque [N m], and matrix [kg m^2] that they add to the inertia.

    The torque is taken at the current rates. The matrix is dt C.
    """

    torque: vec3
    inertia: mat33


@wp.func
def joint_friction(p: JointParams, rates: vec3) -> vec3:
    """Return damping coefficients [N m s/rad] equivalent to a leg's motor damping and friction at `rates` [rad/s].

    A friction torque F at a rate w acts as the damping F / |w|. The implicit step then ends at rest without chatter.
    The floor `FRICTION_SPEED` keeps the damping finite.
    """
    return vec3(
        p.damping[0] + p.friction[0] / wp.max(wp.abs(rates[0]), FRICTION_SPEED),
        p.damping[1] + p.friction[1] / wp.max(wp.abs(rates[1]), FRICTION_SPEED),
        p.damping[2] + p.friction[2] / wp.max(wp.abs(rates[2]), FRICTION_SPEED),
    )


@wp.func
def capped_damping(damping: real, rate: real, limit: real) -> real:
    """Return a damping coefficient [N m s/rad], reduced if its torque at `rate` [rad/s] would exceed `limit` [N m].

    The dampers of the knees saturate: with a constant coefficient, they would take too much energy from a jump.
    """
    return wp.min(damping, limit / wp.max(wp.abs(rate), real(1.0e-6)))


@wp.func
def knee_damping(p: JointParams, loop: FiveBar, front: real, rates: vec3) -> mat33:
    """Return the motor-space damping matrix [N m s/rad] of a leg's passive knees; front, rates: see `joint_forces`.

    A knee turns with both transversal motors, so it damps a combination g . q' of their rates: c g g^T per knee, with
    its coefficient c and gradient g.
    """
    zero = real(0.0)
    # knee rate = shank rate - thigh rate, per outer and inner motor rate
    outer_knee = vec3(zero, loop.outer_shank_do + front, loop.outer_shank_di)
    inner_knee = vec3(zero, loop.inner_shank_do, loop.inner_shank_di - front)
    outer = capped_damping(p.knee_damping_outer, wp.dot(outer_knee, rates), p.knee_limit_outer)
    inner = capped_damping(p.knee_damping_inner, wp.dot(inner_knee, rates), p.knee_limit_inner)
    return outer * wp.outer(outer_knee, outer_knee) + inner * wp.outer(inner_knee, inner_knee)


@wp.func
def joint_forces(
    p: JointParams, loop: FiveBar, front: real, rates: vec3, stop_rates: StopRates, pressed: int, dt: real
) -> JointForces:
    """Return the passive forces of one leg in motor space: friction, knee damping and pressed hard stops.

    front: +1 front leg, -1 back leg. rates [rad/s]: lateral, outer, inner, at the start of the step dt [s]. stop_rates,
    pressed: the leg's hard stops, see `stops`.
    """
    damping = knee_damping(p, loop, front, rates) + wp.diag(joint_friction(p, rates))
    stops = stop_forces(stop_rates, rates, pressed, dt)
    forces = JointForces()
    forces.torque = stops.torque - damping * rates
    forces.inertia = stops.inertia + dt * damping
    return forces
