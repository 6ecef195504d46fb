"""Inverse kinematics of a leg in closed form: paw position to motor angles.

A reachable target takes one closed-form solution: the lateral angle from the circle that the leg's plane touches, then
each thigh angle from the triangle of thigh, shank and the line to the ankle, knees outward. Within the joint limits
every ankle position has exactly one such solution, and `five_bar` returns the same ankle for it. Out of reach the
result is a pose within limits, not the nearest one. No gradients are generated for this file.

Targets are in body axes (x ahead, y left, z up). Motor angles are lateral (positive outward), outer and inner (positive
away from the leg's other thigh). Housing axes are body axes turned about x by the lateral motor. `front`: +1 front leg,
-1 back leg; `side`: +1 left, -1 right.
"""

import warp as wp

from ..scalar import real, vec2, vec3
from .geometry import LegGeometry

wp.set_module_options({"enable_backward": False})


@wp.struct
class LegLimits:
    """Joint limits of a leg [rad]; outer and inner motor share `transversal`. Lower must not exceed upper."""

    lateral_lower: real
    lateral_upper: real  # at most a full turn above lower
    transversal_lower: real  # above -90 degrees
    transversal_upper: real  # below 180 degrees
    sum_lower: real  # of outer + inner; above the pose in which the knees coincide
    sum_upper: real


@wp.func
def clamp_transversal(limits: LegLimits, outer: real, inner: real) -> vec2:
    """Return the thigh angles (outer, inner) [rad] clamped to joint limits.

    Where the sum is out of limits, only `inner` is corrected. `outer` is first limited so that some `inner` fits.
    """
    lower = limits.transversal_lower
    upper = limits.transversal_upper
    clamped_outer = wp.clamp(outer, wp.max(lower, limits.sum_lower - upper), wp.min(upper, limits.sum_upper - lower))
    clamped_inner = wp.clamp(
        inner, wp.max(lower, limits.sum_lower - clamped_outer), wp.min(upper, limits.sum_upper - clamped_outer)
    )
    return vec2(clamped_outer, clamped_inner)


@wp.func
def nearest_lateral(geo: LegGeometry, limits: LegLimits, target: vec3, ankle_z: real) -> real:
    """Return the lateral angle [rad] within limits that brings the ankle nearest to a target [m] relative to the hip.

    ankle_z [m]: the ankle's z in the housing frame. The ankle moves on a circle about x, so the result is the angle
    toward the target, clamped to the limit that is nearer around the circle.
    """
    toward = geo.side * (wp.atan2(target[2], target[1]) - wp.atan2(ankle_z, geo.plane_y + geo.knee_y))
    middle = real(0.5) * (limits.lateral_lower + limits.lateral_upper)
    half = real(0.5) * (limits.lateral_upper - limits.lateral_lower)
    full_turn = real(6.283185307179586)  # arithmetic on wp.pi would be single precision
    off = toward - middle
    off_wrapped = off - full_turn * wp.round(off / full_turn)
    return middle + wp.clamp(off_wrapped, -half, half)


@wp.func
def thigh_angle(geo: LegGeometry, shank: real, away: real, z: real) -> real:
    """Return the motor angle [rad] at which a thigh's shank reaches a point, with its knee away from the other thigh.

    shank [m]: knee to point. away [m]: point from the thigh's axis along x, positive away from the other thigh; z [m]:
    of the point in the housing frame. Out of reach, the leg is stretched or folded toward the point (`wp.acos` clamps
    its argument).
    """
    distance_sq = wp.max(away * away + z * z, real(1.0e-12))
    cosine = (distance_sq + geo.thigh * geo.thigh - shank * shank) / (real(2.0) * geo.thigh * wp.sqrt(distance_sq))
    return wp.atan2(away, -z) + wp.acos(cosine)


@wp.func
def clamped_closed_form(geo: LegGeometry, limits: LegLimits, target: vec3) -> vec3:
    """Return closed-form motor angles [rad] for a paw target [m], clamped to limits; if out of reach, a pose near it.

    target: from the hip, body axes.
    """
    plane = geo.plane_y + geo.knee_y
    z = -wp.sqrt(wp.max(target[1] * target[1] + target[2] * target[2] - plane * plane, real(0.0)))
    inner = thigh_angle(geo, geo.shank + geo.paw_offset, geo.front * (geo.inner_x - target[0]), z)
    # the ankle is on the line from the paw to the inner knee
    beyond = geo.paw_offset / (geo.shank + geo.paw_offset)
    knee = vec2(geo.inner_x - geo.front * geo.thigh * wp.sin(inner), -geo.thigh * wp.cos(inner))
    ankle_x = target[0] + beyond * (knee[0] - target[0])
    outer = thigh_angle(geo, geo.outer_shank, geo.front * (ankle_x - geo.outer_x), z + beyond * (knee[1] - z))
    thighs = clamp_transversal(limits, outer, inner)
    return vec3(nearest_lateral(geo, limits, target, z), thighs[0], thighs[1])
