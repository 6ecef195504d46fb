"""Sampling of the ground of an episode: level, with a platform to jump off, or with a block to jump onto.

With such grounds, policies learn to land below and above their start. Lengths are in world axes, z up; the start is
above the origin. The paws of start and goal must not stand on an edge.
"""

import warp as wp

from ..mdp.random import RngStream, uniform, uniform_range
from ..scalar import real, vec2
from ..terrain.ground import Block
from . import streams
from .start_states import ResetRanges

wp.set_module_options({"enable_backward": False})

MIN_EDGE_DISTANCE = wp.constant(0.05)  # [m] between the paws' centres and an edge of a block
DEFAULT_PAWS = wp.constant(wp.vec2(0.24, 0.2102))  # [m] |x|, |y| of a paw from the base in the default pose


@wp.struct
class GroundRanges:
    """Probabilities and ranges (lower, upper) of a platform to jump off and of a block to jump onto."""

    platform: float  # probability of a platform under the start
    block: float  # probability of a block under the goal
    drop: wp.vec2  # [m] height of the platform
    rise: wp.vec2  # [m] height of the block
    room: float  # [m] largest distance of an edge from the paws inside it; not for a block's near side
    clearance: float  # [m] least distance of a platform's edge, or a block's near side, from the paws at the goal
    mass: wp.vec2  # [kg] of the block
    friction: wp.vec2  # [1] between block and floor


@wp.func
def footprint(ranges: ResetRanges, heading: float) -> wp.vec2:
    """Return half the length and width [m], along world x, y, of a box around the paws in the widest stance.

    heading [rad]: yaw of the stance. Blocks are aligned with the world's axes, so the box is too.
    """
    half_length = wp.max(wp.max(ranges.front_x[1], ranges.back_x[1]), DEFAULT_PAWS[0])
    half_width = wp.max(wp.max(ranges.front_y[1], ranges.back_y[1]), DEFAULT_PAWS[1])
    c = wp.abs(wp.cos(heading))
    s = wp.abs(wp.sin(heading))
    return wp.vec2(c * half_length + s * half_width, s * half_length + c * half_width)


@wp.func
def fixed_block(center: wp.vec2, half: wp.vec2, height: float) -> Block:
    """Return a block that does not slide, since it weighs 10^6 kg; center, half extents and height [m], world axes."""
    block = Block()
    block.exists = 1
    block.start = vec2(real(center[0]), real(center[1]))
    block.center = block.start
    block.half = vec2(real(half[0]), real(half[1]))
    block.height = real(height)
    block.mass = real(1.0e6)
    block.friction = real(1.0)
    return block


@wp.func
def sample_platform(rng: RngStream, ranges: GroundRanges, foot: wp.vec2, goal: wp.vec3) -> Block:
    """Return a platform of sampled size under the origin, or no block if the paws at the goal would be too near to it.

    The paws must be at least `ranges.clearance` away from the platform. foot: half extents [m] of the paws
    (`footprint`); goal [m]: world axes.
    """
    half = foot + wp.vec2(
        uniform(rng, streams.PLATFORM_ROOM_X, MIN_EDGE_DISTANCE, ranges.room),
        uniform(rng, streams.PLATFORM_ROOM_Y, MIN_EDGE_DISTANCE, ranges.room),
    )
    beyond = wp.vec2(wp.abs(goal[0]), wp.abs(goal[1])) - half - foot
    if wp.max(beyond) < ranges.clearance:
        return Block()
    return fixed_block(wp.vec2(0.0), half, uniform_range(rng, streams.BLOCK_HEIGHT, ranges.drop))


@wp.func
def sample_block(rng: RngStream, ranges: GroundRanges, foot: wp.vec2, goal: wp.vec3) -> Block:
    """Return a sampled block under the goal, or no block if goal and start are too close for its near side.

    The near side lies between the paws at the start and the paws at the goal, across the axis (x or y) along which the
    goal is farther. Its distance from the nearest possible place is u^2 times the free length, with u uniform in [0,
    1), so near blocks are frequent. foot, goal: as in `sample_platform`.
    """
    along = wp.where(wp.abs(goal[0]) >= wp.abs(goal[1]), 0, 1)  # axis: 0 x, 1 y
    distance = wp.abs(goal[along])
    nearest = foot[along] + MIN_EDGE_DISTANCE
    farthest = distance - foot[along] - ranges.clearance
    if nearest > farthest:
        return Block()
    u = uniform(rng, streams.BLOCK_NEAR_SIDE, 0.0, 1.0)
    near = nearest + u * u * (farthest - nearest)
    far = distance + foot[along] + uniform(rng, streams.BLOCK_FAR_ROOM, MIN_EDGE_DISTANCE, ranges.room)
    center = wp.vec2(goal[0], goal[1])
    center[along] = wp.sign(goal[along]) * 0.5 * (near + far)
    half = foot + wp.vec2(uniform(rng, streams.BLOCK_SIDE_ROOM, MIN_EDGE_DISTANCE, ranges.room))
    half[along] = 0.5 * (far - near)
    block = fixed_block(center, half, uniform_range(rng, streams.BLOCK_HEIGHT, ranges.rise))
    block.mass = real(uniform_range(rng, streams.BLOCK_MASS, ranges.mass))
    block.friction = real(uniform_range(rng, streams.BLOCK_FRICTION, ranges.friction))
    return block


@wp.func
def sample_ground(rng: RngStream, ranges: GroundRanges, foot: wp.vec2, goal: wp.vec3) -> Block:
    """Return a platform under the start, a block under the goal, or no block, as sampled for a standing start.

    foot, goal: as in `sample_platform`.
    """
    u = uniform(rng, streams.GROUND, 0.0, 1.0)
    if u < ranges.platform:
        return sample_platform(rng, ranges, foot, goal)
    if u < ranges.platform + ranges.block:
        return sample_block(rng, ranges, foot, goal)
    return Block()
