"""Ground under the paws: a plane z = 0 or a heightfield, and optionally a sliding block in each world.

Functions of a point take the ground of one world, whose block `world_ground` has copied to `Ground.block`. Points are
in the world frame, z up. "Floor" is plane or heightfield, without the block.
"""

import warp as wp

from ..scalar import real, vec2, vec3


@wp.struct
class Block:
    """Block on the floor of one world: upright walls and a level top. It slides without turning and never lifts off."""

    exists: int  # 0: no block
    start: vec2  # [m] centre, world, after a reset
    center: vec2  # [m] centre, world
    velocity: vec2  # [m/s] world
    half: vec2  # [m] half extents along x and y
    height: real  # [m] of the top above z = 0
    mass: real  # [kg]
    friction: real  # coefficient of friction with the floor [1]


@wp.struct
class Ground:
    """Ground of the worlds: a plane (`rows` = 0) or a grid of heights, bilinear in between, and optional blocks.

    The grid's centre is `center_x`, `center_y`. Outside the grid the surface continues at the height of the nearest
    edge. Row index follows y, column index x.
    """

    rows: int
    cols: int
    center_x: wp.float32  # [m]
    center_y: wp.float32  # [m]
    half_x: wp.float32  # [m]
    half_y: wp.float32  # [m]
    heights: wp.array2d(dtype=wp.float32)  # [m], (rows, cols); shape (1, 1) for a plane
    blocks: wp.array(dtype=Block)  # (num_worlds,); empty: no blocks
    block: Block  # the block of one world, see `world_ground`


@wp.func
def world_ground(ground: Ground, world: int) -> Ground:
    """Return a copy of the ground with the obstacle (`block`) that stands in a world."""
    here = ground
    if ground.blocks.shape[0] > 0:
        here.block = ground.blocks[world]
    return here


@wp.func
def grown_block(ground: Ground, margin: float) -> Ground:
    """Return a copy of a world's ground whose block is larger by `margin` [m] on all four sides and at the top.

    Collision checks use it: in a training, links must keep this distance from obstacles.
    """
    here = ground
    here.block.half += vec2(real(margin), real(margin))
    here.block.height += real(margin)
    return here


@wp.func
def has_block(ground: Ground, world: int) -> bool:
    """Return whether there is a block in a world."""
    if ground.blocks.shape[0] == 0:
        return False
    return ground.blocks[world].exists != 0


@wp.func
def move_block(ground: Ground, world: int, velocity: vec3, dt: real):
    """Move the block of a world for dt [s] with a velocity [m/s], world frame, and store it; velocity z is ignored."""
    block = ground.blocks[world]
    block.velocity = vec2(velocity[0], velocity[1])
    block.center += dt * block.velocity
    ground.blocks[world] = block


@wp.func
def rest_block(ground: Ground, world: int):
    """Move the block of a world, if there is one, to its start position with zero velocity."""
    if ground.blocks.shape[0] > 0:
        block = ground.blocks[world]
        block.velocity = vec2(real(0.0))
        block.center = block.start
        ground.blocks[world] = block


@wp.func
def floor_surface(ground: Ground, x: real, y: real) -> vec3:
    """Return (height [m], slope along x, slope along y) of the plane or heightfield at world x, y [m]; no block."""
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
def surface(ground: Ground, x: real, y: real) -> vec3:
    """Return (height [m], slope along x, slope along y) of floor and block at world x, y [m]; slopes [1]."""
    floor = floor_surface(ground, x, y)
    if ground.block.exists == 0:
        return floor
    block = ground.block
    over = wp.abs(x - block.center[0]) <= block.half[0] and wp.abs(y - block.center[1]) <= block.half[1]
    if over and block.height > floor[0]:
        return vec3(block.height, real(0.0), real(0.0))
    return floor


@wp.func
def floor_normal(ground: Ground, point: vec3) -> vec3:
    """Return the upward unit normal of the plane or heightfield nearest to a point [m], world frame.

    On a heightfield the foot point is approached by two fixed-point steps along the local normal.
    """
    if ground.rows == 0:
        return vec3(real(0.0), real(0.0), real(1.0))
    here = floor_surface(ground, point[0], point[1])
    normal = wp.normalize(vec3(-here[1], -here[2], real(1.0)))
    foot = point - (point[2] - here[0]) * normal[2] * normal
    there = floor_surface(ground, foot[0], foot[1])
    return wp.normalize(vec3(-there[1], -there[2], real(1.0)))


@wp.func
def floor_distance(ground: Ground, point: vec3) -> real:
    """Return the signed distance [m] of a point from the plane or heightfield, positive above it, world frame.

    Exact for planes of any slope; first order in the curvature of a heightfield.
    """
    if ground.rows == 0:
        return point[2]
    normal = floor_normal(ground, point)
    here = floor_surface(ground, point[0], point[1])
    foot = point - (point[2] - here[0]) * normal[2] * normal
    there = floor_surface(ground, foot[0], foot[1])
    return wp.dot(point - vec3(foot[0], foot[1], there[0]), normal)


@wp.func
def outside_block(block: Block, point: vec3) -> vec3:
    """Return the distances [m] of a point (world) beyond the walls along x, y and above the top; negative inside."""
    return vec3(
        wp.abs(point[0] - block.center[0]) - block.half[0],
        wp.abs(point[1] - block.center[1]) - block.half[1],
        point[2] - block.height,
    )


@wp.func
def block_distance(block: Block, point: vec3) -> real:
    """Return the signed distance [m] of a point (world) from a block extended down to infinity; negative inside."""
    beyond = outside_block(block, point)
    return wp.length(wp.max(beyond, vec3(real(0.0)))) + wp.min(wp.max(beyond), real(0.0))


@wp.func
def block_normal(block: Block, point: vec3) -> vec3:
    """Return the outward unit normal of a block where it is nearest to a point [m], world frame; rounded at edges."""
    beyond = outside_block(block, point)
    out = wp.max(beyond, vec3(real(0.0)))
    if wp.max(beyond) <= real(0.0):
        # inside: out through the nearest face
        nearest = wp.argmax(beyond)
        out[nearest] = real(1.0)
    if point[0] < block.center[0]:
        out[0] = -out[0]
    if point[1] < block.center[1]:
        out[1] = -out[1]
    return wp.normalize(out)


@wp.func
def ground_distance(ground: Ground, point: vec3) -> real:
    """Return the signed distance [m] of a point (world) to the nearer of floor and block, positive outside.

    Measured along the normal, not vertically: see `floor_distance` and `block_distance`.
    """
    distance = floor_distance(ground, point)
    if ground.block.exists != 0:
        distance = wp.min(distance, block_distance(ground.block, point))
    return distance
