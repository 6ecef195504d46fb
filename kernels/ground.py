"""The ground that the paws stand on: a plane z = 0, or a heightfield."""

import warp as wp

from .scalar import real, vec3


@wp.struct
class Ground:
    """A horizontal plane (`rows` = 0) or a grid of heights centred on (`center_x`, `center_y`), bilinear between nodes.

    Outside the grid the surface continues at the height of the nearest edge. Row index follows y, column index x.
    """

    rows: int
    cols: int
    center_x: wp.float32  # [m]
    center_y: wp.float32  # [m]
    half_x: wp.float32  # [m]
    half_y: wp.float32  # [m]
    heights: wp.array2d(dtype=wp.float32)  # [m], (rows, cols); shape (1, 1) for a plane


@wp.func
def surface(ground: Ground, x: real, y: real) -> vec3:
    """Return (height [m], slope along x, slope along y) of the ground surface at a point of the world plane."""
    if ground.rows == 0:
        return vec3(real(0.0))
    dx = real(2.0) * real(ground.half_x) / real(ground.cols - 1)
    dy = real(2.0) * real(ground.half_y) / real(ground.rows - 1)
    u = wp.clamp((x - real(ground.center_x) + real(ground.half_x)) / dx, real(0.0), real(ground.cols - 1))
    v = wp.clamp((y - real(ground.center_y) + real(ground.half_y)) / dy, real(0.0), real(ground.rows - 1))
    col = wp.min(int(wp.floor(u)), ground.cols - 2)
    row = wp.min(int(wp.floor(v)), ground.rows - 2)
    fu = u - real(col)
    fv = v - real(row)
    h00 = real(ground.heights[row, col])
    h01 = real(ground.heights[row, col + 1])
    h10 = real(ground.heights[row + 1, col])
    h11 = real(ground.heights[row + 1, col + 1])
    along_x0 = h01 - h00
    along_x1 = h11 - h10
    low = h00 + fu * along_x0
    high = h10 + fu * along_x1
    return vec3(low + fv * (high - low), (along_x0 + fv * (along_x1 - along_x0)) / dx, (high - low) / dy)


@wp.func
def ground_normal(ground: Ground, point: vec3) -> vec3:
    """Return the upward unit normal of the surface nearest to a point [m], world frame.

    On a heightfield the foot point is approached by two fixed-point steps along the local normal.
    """
    if ground.rows == 0:
        return vec3(real(0.0), real(0.0), real(1.0))
    here = surface(ground, point[0], point[1])
    normal = wp.normalize(vec3(-here[1], -here[2], real(1.0)))
    foot = point - (point[2] - here[0]) * normal[2] * normal
    there = surface(ground, foot[0], foot[1])
    return wp.normalize(vec3(-there[1], -there[2], real(1.0)))


@wp.func
def ground_distance(ground: Ground, point: vec3) -> real:
    """Return the signed distance [m] of a point from the surface, positive above it, world frame.

    Exact for planes of any slope; first order in the curvature of a heightfield.
    """
    if ground.rows == 0:
        return point[2]
    normal = ground_normal(ground, point)
    here = surface(ground, point[0], point[1])
    foot = point - (point[2] - here[0]) * normal[2] * normal
    there = surface(ground, foot[0], foot[1])
    return wp.dot(point - vec3(foot[0], foot[1], there[0]), normal)
