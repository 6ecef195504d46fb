"""Planar five-bar loop of one leg: position, velocity and bias acceleration in closed form.

All points are (x, z) [m] in the motor housing frame. The two thighs turn about the transversal axes; a positive
motor angle moves the thigh tip away from the other. The loop constraint (paper, Eq. 1) holds by construction: the
ankle is the intersection of the two shank circles, on the branch below the knees. Rotation angles of links are about
housing +y, 0 for a link that hangs along -z. x is ahead, z up. The outer thigh is the one farther from the body's
middle; f = `LegGeometry.front` (+1 front leg, -1 back leg) mirrors x, so that equal angles give mirrored legs.

Suffixes: _do, _di are derivatives w.r.t. the outer and inner motor angle; _acc of `FiveBarBias` are accelerations at
zero motor acceleration.
"""

import warp as wp

from ..scalar import real, vec2, vec3
from .geometry import LegGeometry
from .trig import sin_cos


@wp.struct
class FiveBar:
    """Configuration of the five-bar loop and its first derivatives with respect to the outer and inner motor angles."""

    outer_sin_cos: vec2  # (sine, cosine) of the outer motor angle
    inner_sin_cos: vec2  # (sine, cosine) of the inner motor angle
    outer_knee: vec2  # [m]
    inner_knee: vec2  # [m]
    ankle: vec2  # [m]
    paw: vec2  # [m] centre of the paw
    outer_shank: vec2  # unit vector, outer knee to ankle
    inner_shank: vec2  # unit vector, inner knee to ankle
    outer_knee_do: vec2  # [m/rad] d outer_knee / d outer angle
    inner_knee_di: vec2  # [m/rad] d inner_knee / d inner angle
    ankle_do: vec2  # [m/rad] d ankle / d outer angle
    ankle_di: vec2  # [m/rad] d ankle / d inner angle
    paw_do: vec2  # [m/rad] d paw / d outer angle
    paw_di: vec2  # [m/rad] d paw / d inner angle
    outer_shank_do: real  # [1] d (rotation of the outer shank) / d outer angle
    outer_shank_di: real  # [1] d (rotation of the outer shank) / d inner angle
    inner_shank_do: real  # [1] d (rotation of the inner shank) / d outer angle
    inner_shank_di: real  # [1] d (rotation of the inner shank) / d inner angle


@wp.struct
class FiveBarBias:
    """Link rates of the five-bar loop, and its accelerations at zero motor acceleration (velocity-product terms)."""

    outer_thigh_rate: real  # [rad/s] about +y
    inner_thigh_rate: real
    outer_shank_rate: real
    inner_shank_rate: real
    outer_knee_acc: vec2  # [m/s^2]
    inner_knee_acc: vec2
    ankle_acc: vec2
    outer_shank_acc: real  # [rad/s^2] about +y
    inner_shank_acc: real


@wp.func
def rotation_rate(direction: vec2, velocity: vec2, length: real) -> real:
    """Return a five-bar link's rate about +y [rad/s] from the velocity [m/s] of its far end relative to its near end.

    direction: unit vector (x, z) from the near end to the far end; length [m]. With an acceleration in place of the
    velocity, the result is in [rad/s^2].
    """
    return (direction[1] * velocity[0] - direction[0] * velocity[1]) / length


@wp.func
def solve_projections(a: vec2, b: vec2, along_a: real, along_b: real) -> vec2:
    """Return the plane vector x with given projections on two unit vectors: a.x = along_a and b.x = along_b.

    With a and b along the shanks, x is the ankle's velocity: a rigid shank moves equally fast along itself at both
    ends, so that the knees' velocities give both projections. If the vectors are parallel to within 1e-4 rad, x is
    finite, but does not have these projections.
    """
    det = a[0] * b[1] - a[1] * b[0]
    # det is the sine of the angle between the shanks. It is 0 where the ankle and both knees lie on a line: the loop is
    # stretched, or folded (shanks of equal length: the knees coincide). A size of at least 1e-4 keeps x finite
    if wp.abs(det) < real(1.0e-4):
        det = wp.where(det < real(0.0), real(-1.0e-4), real(1.0e-4))
    return vec2(along_a * b[1] - along_b * a[1], along_b * a[0] - along_a * b[0]) / det


@wp.func
def five_bar(geo: LegGeometry, outer: real, inner: real) -> FiveBar:
    """Return the five-bar's configuration and derivatives at the motor angles `outer` and `inner` [rad]."""
    f = geo.front
    loop = FiveBar()
    outer_sin_cos, inner_sin_cos = sin_cos(outer), sin_cos(inner)
    outer_sin, outer_cos = outer_sin_cos[0], outer_sin_cos[1]
    inner_sin, inner_cos = inner_sin_cos[0], inner_sin_cos[1]
    outer_knee = vec2(geo.outer_x + f * geo.thigh * outer_sin, -geo.thigh * outer_cos)
    inner_knee = vec2(geo.inner_x - f * geo.thigh * inner_sin, -geo.thigh * inner_cos)
    outer_knee_do = vec2(f * geo.thigh * outer_cos, geo.thigh * outer_sin)
    inner_knee_di = vec2(-f * geo.thigh * inner_cos, geo.thigh * inner_sin)

    span = outer_knee - inner_knee
    span_sq = wp.max(wp.dot(span, span), real(1.0e-8))
    # of the ankle from the middle between the knees toward the outer one, in units of their distance
    skew = real(0.5) * (geo.shank - geo.outer_shank) * (geo.shank + geo.outer_shank) / span_sq
    below_sq = geo.shank * geo.shank - real(0.25) * span_sq - skew * (real(1.0) + skew) * span_sq
    height_sq = wp.max(below_sq, real(1.0e-8))
    middle = real(0.5) * (outer_knee + inner_knee) + skew * span
    ankle = middle + f * wp.sqrt(height_sq / span_sq) * vec2(span[1], -span[0])
    outer_shank = (ankle - outer_knee) / geo.outer_shank
    inner_shank = (ankle - inner_knee) / geo.shank
    ankle_do = solve_projections(outer_shank, inner_shank, wp.dot(outer_shank, outer_knee_do), real(0.0))
    ankle_di = solve_projections(outer_shank, inner_shank, real(0.0), wp.dot(inner_shank, inner_knee_di))

    loop.outer_sin_cos = outer_sin_cos
    loop.inner_sin_cos = inner_sin_cos
    loop.outer_knee = outer_knee
    loop.inner_knee = inner_knee
    loop.ankle = ankle
    loop.outer_shank = outer_shank
    loop.inner_shank = inner_shank
    loop.outer_knee_do = outer_knee_do
    loop.inner_knee_di = inner_knee_di
    loop.ankle_do = ankle_do
    loop.ankle_di = ankle_di
    loop.outer_shank_do = rotation_rate(outer_shank, ankle_do - outer_knee_do, geo.outer_shank)
    loop.outer_shank_di = rotation_rate(outer_shank, ankle_di, geo.outer_shank)
    loop.inner_shank_do = rotation_rate(inner_shank, ankle_do, geo.shank)
    loop.inner_shank_di = rotation_rate(inner_shank, ankle_di - inner_knee_di, geo.shank)
    # the paw lies on the inner shank, or beyond its ankle
    turn = geo.paw_offset * vec2(inner_shank[1], -inner_shank[0])
    loop.paw = ankle + geo.paw_offset * inner_shank
    loop.paw_do = ankle_do + loop.inner_shank_do * turn
    loop.paw_di = ankle_di + loop.inner_shank_di * turn
    return loop


@wp.func
def five_bar_bias(geo: LegGeometry, loop: FiveBar, outer_rate: real, inner_rate: real) -> FiveBarBias:
    """Return the five-bar's link rates and velocity-product accelerations for the motor rates [rad/s].

    The equations of motion need these values, since constant motor rates do not imply constant link rates. Along each
    shank, the acceleration of the ankle is the acceleration of the knee less the centripetal acceleration of the shank.
    """
    f = geo.front
    bias = FiveBarBias()
    outer_knee_vel = outer_rate * loop.outer_knee_do
    inner_knee_vel = inner_rate * loop.inner_knee_di
    ankle_vel = outer_rate * loop.ankle_do + inner_rate * loop.ankle_di
    # circular motion of the knees about the transversal axes
    outer_knee_acc = outer_rate * outer_rate * (vec2(geo.outer_x, real(0.0)) - loop.outer_knee)
    inner_knee_acc = inner_rate * inner_rate * (vec2(geo.inner_x, real(0.0)) - loop.inner_knee)
    outer_rel = ankle_vel - outer_knee_vel
    inner_rel = ankle_vel - inner_knee_vel
    ankle_acc = solve_projections(
        loop.outer_shank,
        loop.inner_shank,
        wp.dot(loop.outer_shank, outer_knee_acc) - wp.dot(outer_rel, outer_rel) / geo.outer_shank,
        wp.dot(loop.inner_shank, inner_knee_acc) - wp.dot(inner_rel, inner_rel) / geo.shank,
    )
    bias.outer_thigh_rate = -f * outer_rate
    bias.inner_thigh_rate = f * inner_rate
    bias.outer_shank_rate = loop.outer_shank_do * outer_rate + loop.outer_shank_di * inner_rate
    bias.inner_shank_rate = loop.inner_shank_do * outer_rate + loop.inner_shank_di * inner_rate
    bias.outer_knee_acc = outer_knee_acc
    bias.inner_knee_acc = inner_knee_acc
    bias.ankle_acc = ankle_acc
    bias.outer_shank_acc = rotation_rate(loop.outer_shank, ankle_acc - outer_knee_acc, geo.outer_shank)
    bias.inner_shank_acc = rotation_rate(loop.inner_shank, ankle_acc - inner_knee_acc, geo.shank)
    return bias


@wp.func
def in_plane(p: vec2, y: real) -> vec3:
    """Return the point (x, z) `p` of the five-bar plane as a vector (x, y, z) of the housing frame."""
    return vec3(p[0], y, p[1])
