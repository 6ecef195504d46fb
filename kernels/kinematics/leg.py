"""Forward kinematics and inverse velocity kinematics of one leg.

Motor angles and rates are ordered lateral, outer, inner. A leg's housing turns
about (side, 0, 0) through the hip, so that a positive lateral angle swings the paw outward; a positive outer or inner
angle moves a thigh away from the leg's other thigh. Body axes are x ahead, y left, z up; side: +1 left, -1 right;
front: +1 front leg, -1 back leg. The five-bar loop is planar: points (x, z) of the housing, at constant y.
"""

import warp as wp

from ..scalar import real, vec2, vec3
from .five_bar import FiveBar, five_bar
from .geometry import LegGeometry

LEVER_FLOOR = wp.constant(real(0.01))  # [m/rad] below this lever rates are damped, see `damped_ratio`


@wp.func
def rotate_lateral(geo: LegGeometry, lateral: real, housing_vector: vec3) -> vec3:
    """Return a housing-frame vector in body axes, for the lateral angle [rad]; -lateral gives the inverse rotation."""
    c = wp.cos(lateral)
    s = geo.side * wp.sin(lateral)
    return vec3(
        housing_vector[0], c * housing_vector[1] - s * housing_vector[2], s * housing_vector[1] + c * housing_vector[2]
    )


@wp.func
def paw_in_housing(geo: LegGeometry, loop: FiveBar) -> vec3:
    """Return the position [m] of the paw's centre in the housing frame, whose origin is the hip."""
    return vec3(loop.paw[0], geo.plane_y + geo.knee_y, loop.paw[1])


@wp.func
def leg_forward_kinematics(geo: LegGeometry, lateral: real, outer: real, inner: real) -> vec3:
    """Return the position [m] of the paw's centre in the body frame, for the motor angles [rad]."""
    loop = five_bar(geo, outer, inner)
    return geo.hip + rotate_lateral(geo, lateral, paw_in_housing(geo, loop))


@wp.func
def damped_ratio(speed: real, lever: real) -> real:
    """Return a thigh's rate [rad/s] for an ankle speed along the shank, damped where thigh and shank nearly align.

    The rate is speed / lever, or speed lever / LEVER_FLOOR^2 where |lever| < LEVER_FLOOR. speed [m/s] of the ankle
    along the shank; lever [m/rad]: knee speed along the shank per thigh rate. |lever| is below LEVER_FLOOR where thigh
    and shank are within 3.3 degrees of one line, and no bounded rate reaches the speed.
    """
    return speed * lever / wp.max(lever * lever, LEVER_FLOOR * LEVER_FLOOR)


@wp.func
def leg_inverse_velocity(geo: LegGeometry, angles: vec3, paw_vel: vec3) -> vec3:
    """Return motor rates [rad/s] that move the paw at `paw_vel` [m/s] relative to the body, in the body frame.

    Exact at motor angles [rad] within joint limits, unless a thigh and its shank are within 3.3 degrees of one line;
    there the rates are damped, to at most 100 rad/s per m/s along the shank.
    """
    loop = five_bar(geo, angles[1], angles[2])
    vel = rotate_lateral(geo, -angles[0], paw_vel)
    # only the lateral motor moves the paw along housing y; within joint limits the paw is 0.1 m below or more
    lateral_rate = -geo.side * vel[1] / wp.min(loop.paw[1], real(-0.01))
    in_plane = vec2(vel[0], vel[2] - geo.side * lateral_rate * (geo.plane_y + geo.knee_y))
    # shanks are rigid: ankle, paw and knee move equally fast along them
    inner_rate = damped_ratio(wp.dot(loop.inner_shank, in_plane), wp.dot(loop.inner_shank, loop.inner_knee_di))
    beyond = geo.paw_offset / (geo.shank + geo.paw_offset)
    ankle_vel = in_plane - beyond * (in_plane - inner_rate * loop.inner_knee_di)
    outer_rate = damped_ratio(wp.dot(loop.outer_shank, ankle_vel), wp.dot(loop.outer_shank, loop.outer_knee_do))
    return vec3(lateral_rate, outer_rate, inner_rate)


@wp.func
def knee_angles(geo: LegGeometry, loop: FiveBar, outer: real, inner: real) -> vec2:
    """Return the passive (outer, inner) knee angles [rad] of a loop at motor angles [rad]; positive bends inward.

    A knee angle is the rotation of the shank less the rotation of the thigh; rotations are about housing +y, from -z.
    """
    outer_shank = wp.atan2(-loop.outer_shank[0], -loop.outer_shank[1])
    inner_shank = wp.atan2(-loop.inner_shank[0], -loop.inner_shank[1])
    return vec2(outer + geo.front * outer_shank, inner - geo.front * inner_shank)
