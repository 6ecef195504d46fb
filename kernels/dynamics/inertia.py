"""Mass properties: zeroth, first and second moments of a mass distribution.

Packed second moments are S = integral of r r^T dm [kg m^2] about a stated point, as (xx, yy, zz, xy, xz, yz). Moments
of several links about one point add up; the inertia tensor is trace(S) 1 - S. S turns with its
links as r r^T does, which makes its rotations and derivatives short.

Angles of rotation are given as cosine c and sine s, which the kinematics have already; -s inverts a rotation. Vectors
and derivatives in the plane of a leg (xz) are stored without their y, which is 0.
"""

import warp as wp

from ..scalar import mat33, real, vec2, vec3, vec5, vec6


@wp.struct
class MassMoments:
    """Mass, first and second moments of mass of one or more links, about a point and in axes that each use states."""

    mass: real  # [kg]
    first: vec3  # [kg m]
    second: vec6  # [kg m^2], xx yy zz xy xz yz


@wp.func
def trace(s: vec6) -> real:
    """Return the trace [kg m^2] of the matrix of packed second moments."""
    return s[0] + s[1] + s[2]


@wp.func
def mul(s: vec6, v: vec3) -> vec3:
    """Return the product S v of the symmetric matrix S in packed second moments and a vector v."""
    return vec3(
        s[0] * v[0] + s[3] * v[1] + s[4] * v[2],
        s[3] * v[0] + s[1] * v[1] + s[5] * v[2],
        s[4] * v[0] + s[5] * v[1] + s[2] * v[2],
    )


@wp.func
def mul_plane(s: vec5, v: vec3) -> vec3:
    """Return the product S v of packed second moments S with yy = 0, stored as (xx, zz, xy, xz, yz), and a vector."""
    return vec3(
        s[0] * v[0] + s[2] * v[1] + s[3] * v[2], s[2] * v[0] + s[4] * v[2], s[3] * v[0] + s[4] * v[1] + s[1] * v[2]
    )


@wp.func
def inertia_mul(s: vec6, v: vec3) -> vec3:
    """Return the product I v of the inertia tensor I of packed second moments and a vector."""
    return trace(s) * v - mul(s, v)


@wp.func
def inertia_matrix(s: vec6) -> mat33:
    """Return the inertia tensor [kg m^2] of packed second moments."""
    return mat33(
        s[1] + s[2], -s[3], -s[4],
        -s[3], s[0] + s[2], -s[5],
        -s[4], -s[5], s[0] + s[1],
    )  # fmt: skip


@wp.func
def sym_outer(a: vec3, b: vec3) -> vec6:
    """Return the symmetric matrix a b^T + b a^T of two vectors, packed as (xx, yy, zz, xy, xz, yz)."""
    two = real(2.0)
    return vec6(
        two * a[0] * b[0], two * a[1] * b[1], two * a[2] * b[2],
        a[0] * b[1] + a[1] * b[0], a[0] * b[2] + a[2] * b[0], a[1] * b[2] + a[2] * b[1],
    )  # fmt: skip


@wp.func
def rotate_y(v: vec3, c: real, s: real) -> vec3:
    """Return v rotated about +y by the angle with cosine c and sine s."""
    return vec3(c * v[0] + s * v[2], v[1], c * v[2] - s * v[0])


@wp.func
def rotate_y_second(m: vec6, c: real, s: real) -> vec6:
    """Return packed second moments rotated about +y by the angle with cosine c and sine s."""
    cc = c * c
    ss = s * s
    cs = c * s
    cross = real(2.0) * cs * m[4]
    return vec6(
        cc * m[0] + cross + ss * m[2],
        m[1],
        ss * m[0] - cross + cc * m[2],
        c * m[3] + s * m[5],
        cs * (m[2] - m[0]) + (cc - ss) * m[4],
        c * m[5] - s * m[3],
    )


@wp.func
def rotate_x(v: vec3, c: real, s: real) -> vec3:
    """Return v rotated about +x by the angle with cosine c and sine s."""
    return vec3(v[0], c * v[1] - s * v[2], s * v[1] + c * v[2])


@wp.func
def rotate_x_second(m: vec6, c: real, s: real) -> vec6:
    """Return packed second moments rotated about +x by the angle with cosine c and sine s."""
    cc = c * c
    ss = s * s
    cs = c * s
    cross = real(2.0) * cs * m[5]
    return vec6(
        m[0],
        cc * m[1] - cross + ss * m[2],
        ss * m[1] + cross + cc * m[2],
        c * m[3] - s * m[4],
        s * m[3] + c * m[4],
        cs * (m[1] - m[2]) + (cc - ss) * m[5],
    )


@wp.func
def rotate_x_plane(v: vec2, c: real, s: real) -> vec3:
    """Return a vector of the xz plane, (v[0], 0, v[1]), rotated about +x by the angle with cosine c and sine s."""
    return vec3(v[0], -s * v[1], c * v[1])


@wp.func
def skew(v: vec3) -> mat33:
    """Return the cross-product matrix [v]x of v, with [v]x u = v x u."""
    zero = real(0.0)
    return mat33(zero, -v[2], v[1], v[2], zero, -v[0], -v[1], v[0], zero)


@wp.func
def symmetric(xx: real, xy: real, xz: real, yy: real, yz: real, zz: real) -> mat33:
    """Return the symmetric 3x3 matrix with the given entries of its upper triangle."""
    return mat33(xx, xy, xz, xy, yy, yz, xz, yz, zz)


@wp.func
def inverse_symmetric(m: mat33) -> mat33:
    """Return the inverse of a symmetric matrix, by cofactors; only the upper triangle is read.

    The inverse of a singular matrix is zero here, so that a body without inertia causes no division by 0.
    """
    xx = m[1, 1] * m[2, 2] - m[1, 2] * m[1, 2]
    xy = m[0, 2] * m[1, 2] - m[0, 1] * m[2, 2]
    xz = m[0, 1] * m[1, 2] - m[0, 2] * m[1, 1]
    det = m[0, 0] * xx + m[0, 1] * xy + m[0, 2] * xz
    scale = real(0.0)
    if det != real(0.0):
        scale = real(1.0) / det
    yy = m[0, 0] * m[2, 2] - m[0, 2] * m[0, 2]
    yz = m[0, 1] * m[0, 2] - m[0, 0] * m[1, 2]
    zz = m[0, 0] * m[1, 1] - m[0, 1] * m[0, 1]
    return symmetric(scale * xx, scale * xy, scale * xz, scale * yy, scale * yz, scale * zz)
