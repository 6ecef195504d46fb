"""One leg from motor angles to its paw, and back again for velocities.

Motor angles and rates are ordered lateral, outer, inner. The ankle is the centre of the paw. A leg's housing turns
about (side, 0, 0) through the hip, so that a positive lateral angle swings the paw outward.
"""

import warp as wp

from ..scalar import mat33, real, vec2, vec3
from .five_bar import FiveBar, five_bar
from .geometry import LegGeometry


@wp.func
def rotate_lateral(geo: LegGeometry, lateral: real, housing_vector: vec3) -> vec3:
    """Return a housing-frame vector in the body frame, for the lateral angle [rad]; a negated angle turns back."""
    c = wp.cos(lateral)
    s = geo.side * wp.sin(lateral)
    return vec3(
        housing_vector[0], c * housing_vector[1] - s * housing_vector[2], s * housing_vector[1] + c * housing_vector[2]
    )


@wp.func
def ankle_in_housing(geo: LegGeometry, loop: FiveBar) -> vec3:
    """Return the ankle [m] in the housing frame, that is, relative to the hip."""
    return vec3(loop.ankle[0], geo.plane_y + geo.knee_y, loop.ankle[1])


@wp.func
def leg_forward_kinematics(geo: LegGeometry, lateral: real, outer: real, inner: real) -> vec3:
    """Return the ankle [m] in the body frame, for motor angles [rad]."""
    loop = five_bar(geo, outer, inner)
    return geo.hip + rotate_lateral(geo, lateral, ankle_in_housing(geo, loop))


@wp.func
def leg_jacobian(geo: LegGeometry, lateral: real, outer: real, inner: real) -> mat33:
    """Return d ankle / d (lateral, outer, inner) [m/rad], shape (3, 3), ankle in the body frame, angles in rad."""
    loop = five_bar(geo, outer, inner)
    arm = rotate_lateral(geo, lateral, ankle_in_housing(geo, loop))
    by_outer = rotate_lateral(geo, lateral, vec3(loop.ankle_do[0], real(0.0), loop.ankle_do[1]))
    by_inner = rotate_lateral(geo, lateral, vec3(loop.ankle_di[0], real(0.0), loop.ankle_di[1]))
    return mat33(
        real(0.0), by_outer[0], by_inner[0],
        -geo.side * arm[2], by_outer[1], by_inner[1],
        geo.side * arm[1], by_outer[2], by_inner[2],
    )  # fmt: skip


@wp.func
def damped_ratio(value: real, divisor: real) -> real:
    """Return value / divisor, fading to zero where the divisor's magnitude is below 10 mm.

    The divisor is the ankle's lever about a thigh axis along the shank [m/rad]; it is below 10 mm where thigh and shank
    are within 3.3 degrees of one line, and no sensible rate gives the wanted velocity.
    """
    floor = real(0.01)
    return value * divisor / wp.max(divisor * divisor, floor * floor)


@wp.func
def leg_inverse_velocity(geo: LegGeometry, angles: vec3, ankle_vel: vec3) -> vec3:
    """Return motor rates [rad/s] that move the ankle at `ankle_vel` [m/s] relative to the body, in the body frame.

    The inverse of `leg_jacobian`, exact within joint limits unless a thigh and its shank are within 3.3 degrees of one
    line; nearer to it the rates are damped: at most 100 rad/s per m/s along the shank.
    """
    loop = five_bar(geo, angles[1], angles[2])
    vel = rotate_lateral(geo, -angles[0], ankle_vel)
    # only the lateral motor moves the ankle along housing y; within joint limits the ankle is 0.1 m below or more
    lateral_rate = -geo.side * vel[1] / wp.min(loop.ankle[1], real(-0.01))
    in_plane = vec2(vel[0], vel[2] - geo.side * lateral_rate * (geo.plane_y + geo.knee_y))
    # shanks are rigid: ankle and knee move equally fast along them
    outer_rate = damped_ratio(wp.dot(loop.outer_shank, in_plane), wp.dot(loop.outer_shank, loop.outer_knee_do))
    inner_rate = damped_ratio(wp.dot(loop.inner_shank, in_plane), wp.dot(loop.inner_shank, loop.inner_knee_di))
    return vec3(lateral_rate, outer_rate, inner_rate)


@wp.func
def knee_angles(geo: LegGeometry, loop: FiveBar, outer: real, inner: real) -> vec2:
    """Return the passive outer and inner knee angle [rad] of a loop configuration; positive folds the shank back."""
    outer_shank = wp.atan2(-loop.outer_shank[0], -loop.outer_shank[1])
    inner_shank = wp.atan2(-loop.inner_shank[0], -loop.inner_shank[1])
    return vec2(outer + geo.front * outer_shank, inner - geo.front * inner_shank)
