"""Passive forces in motor space: friction, damping and hard stops, implicit in the end-of-step rates.

Each force is linear in the rates after the step, tau = b - C q'(t + dt), so that it adds dt C to the inertia and
b - C q'(t) to the torque: stiff stops stay stable at any step size.
"""

import warp as wp

from ..kinematics.five_bar import FiveBar
from ..scalar import mat33, real, vec3

# below this rate [rad/s] Coulomb friction falls linearly to zero
FRICTION_SPEED = wp.constant(real(0.01))


@wp.struct
class JointParams:
    """Joint-space parameters of one leg; vectors are lateral, outer, inner."""

    armature: vec3  # [kg m^2]
    friction: vec3  # [N m]
    damping: vec3  # [N m s/rad]
    knee_damping_outer: real  # [N m s/rad]
    knee_damping_inner: real
    knee_limit_outer: real  # [N m] largest torque of the knee damping
    knee_limit_inner: real
    lower: vec3  # [rad]
    upper: vec3
    sum_lower: real  # [rad]
    sum_upper: real
    stop_ke: real  # [N m/rad]
    stop_kd: real  # [N m s/rad]


@wp.struct
class JointForces:
    """Implicit motor-space forces: torque [N m] at the current rates, and dt C [kg m^2] to add to the inertia."""

    torque: vec3
    inertia: mat33


@wp.func
def stop_inertia(angle: real, rate: real, lower: real, upper: real, ke: real, kd: real, dt: real) -> real:
    """Return dt C [kg m^2] of a pair of hard stops; zero while the joint stays inside through the step."""
    ahead = angle + dt * rate
    if ahead < lower:
        return dt * (dt * ke + wp.where(rate < real(0.0), kd, real(0.0)))
    if ahead > upper:
        return dt * (dt * ke + wp.where(rate > real(0.0), kd, real(0.0)))
    return real(0.0)


@wp.func
def stop_torque(angle: real, rate: real, lower: real, upper: real, ke: real, kd: real, dt: real) -> real:
    """Return the torque [N m] of a pair of hard stops at the current rate: a stiff spring, damped while approaching."""
    ahead = angle + dt * rate
    if ahead < lower:
        return ke * (lower - ahead) - wp.where(rate < real(0.0), kd * rate, real(0.0))
    if ahead > upper:
        return ke * (upper - ahead) - wp.where(rate > real(0.0), kd * rate, real(0.0))
    return real(0.0)


@wp.func
def joint_friction(p: JointParams, rates: vec3) -> vec3:
    """Return the viscous coefficients [N m s/rad] of motor damping and Coulomb friction at the current rates."""
    return vec3(
        p.damping[0] + p.friction[0] / wp.max(wp.abs(rates[0]), FRICTION_SPEED),
        p.damping[1] + p.friction[1] / wp.max(wp.abs(rates[1]), FRICTION_SPEED),
        p.damping[2] + p.friction[2] / wp.max(wp.abs(rates[2]), FRICTION_SPEED),
    )


@wp.func
def capped_damping(damping: real, rate: real, limit: real) -> real:
    """Return the viscous coefficient [N m s/rad] of a damper whose torque never exceeds `limit` [N m]."""
    return wp.min(damping, limit / wp.max(wp.abs(rate), real(1.0e-6)))


@wp.func
def knee_damping(p: JointParams, loop: FiveBar, front: real, rates: vec3) -> mat33:
    """Return the motor-space damping matrix [N m s/rad] of a leg's passive knees."""
    zero = real(0.0)
    # knee rate = shank rate - thigh rate, per outer and inner motor rate
    outer_knee = vec3(zero, loop.outer_shank_do + front, loop.outer_shank_di)
    inner_knee = vec3(zero, loop.inner_shank_do, loop.inner_shank_di - front)
    outer = capped_damping(p.knee_damping_outer, wp.dot(outer_knee, rates), p.knee_limit_outer)
    inner = capped_damping(p.knee_damping_inner, wp.dot(inner_knee, rates), p.knee_limit_inner)
    return outer * wp.outer(outer_knee, outer_knee) + inner * wp.outer(inner_knee, inner_knee)


@wp.func
def joint_forces(p: JointParams, loop: FiveBar, front: real, angles: vec3, rates: vec3, dt: real) -> JointForces:
    """Return friction, knee damping and hard stops of one leg.

    angles, rates: lateral, outer, inner [rad], [rad/s]; dt: step [s].
    """
    zero = real(0.0)
    damping = knee_damping(p, loop, front, rates) + wp.diag(joint_friction(p, rates))
    fold = angles[1] + angles[2]
    fold_rate = rates[1] + rates[2]
    stops = vec3(
        stop_torque(angles[0], rates[0], p.lower[0], p.upper[0], p.stop_ke, p.stop_kd, dt),
        stop_torque(angles[1], rates[1], p.lower[1], p.upper[1], p.stop_ke, p.stop_kd, dt),
        stop_torque(angles[2], rates[2], p.lower[2], p.upper[2], p.stop_ke, p.stop_kd, dt),
    )
    fold_stop = stop_torque(fold, fold_rate, p.sum_lower, p.sum_upper, p.stop_ke, p.stop_kd, dt)
    stops_inertia = vec3(
        stop_inertia(angles[0], rates[0], p.lower[0], p.upper[0], p.stop_ke, p.stop_kd, dt),
        stop_inertia(angles[1], rates[1], p.lower[1], p.upper[1], p.stop_ke, p.stop_kd, dt),
        stop_inertia(angles[2], rates[2], p.lower[2], p.upper[2], p.stop_ke, p.stop_kd, dt),
    )
    both = vec3(zero, real(1.0), real(1.0))
    fold_inertia = stop_inertia(fold, fold_rate, p.sum_lower, p.sum_upper, p.stop_ke, p.stop_kd, dt)

    forces = JointForces()
    forces.torque = stops + fold_stop * both - damping * rates
    forces.inertia = dt * damping + wp.diag(stops_inertia) + fold_inertia * wp.outer(both, both)
    return forces
