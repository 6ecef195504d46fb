"""Sampled ground of an episode: level, a platform to jump off, or a block to jump onto, which may slide."""

import warp as wp

from ..mdp.random import RngStream, uniform, uniform_range
from ..scalar import real, vec2
from ..terrain.ground import Block
from . import streams
from .start_states import ResetRanges

wp.set_module_options({"enable_backward": False})

EVERY_SIDE = wp.constant(0.05)  # [m] between the paws' centres and an edge, at least
DEFAULT_PAWS = wp.constant(wp.vec2(0.24, 0.2102))  # [m] from the base, ahead and beside, in the default pose


@wp.struct
class GroundRanges:
    """Shares of standing starts, and ranges of what they stand on or jump to; pairs are (lower, upper)."""

    platform: float  # share
    block: float  # share
    drop: wp.vec2  # [m] height of the platform
    rise: wp.vec2  # [m] height of the block
    room: float  # [m] most between the paws and an edge, but for a block's near side
    clearance: float  # [m] least between an edge and the place of the paws at the goal
    mass: wp.vec2  # [kg] of the block
    friction: wp.vec2  # of block and floor [1]


@wp.func
def footprint(ranges: ResetRanges, heading: float) -> wp.vec2:
    """Return the half extents [m] along world x and y of the rectangle that the paws' centres fill."""
    half_length = wp.max(wp.max(ranges.front_x[1], ranges.back_x[1]), DEFAULT_PAWS[0])
    half_width = wp.max(wp.max(ranges.front_y[1], ranges.back_y[1]), DEFAULT_PAWS[1])
    c = wp.abs(wp.cos(heading))
    s = wp.abs(wp.sin(heading))
    return wp.vec2(c * half_length + s * half_width, s * half_length + c * half_width)


@wp.func
def fixed_block(center: wp.vec2, half: wp.vec2, height: float) -> Block:
    """Return a block that is too heavy to slide; lengths [m]."""
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
    """Return a sampled platform under a robot at the origin; none if its paws could not land beside it."""
    half = foot + wp.vec2(
        uniform(rng, streams.PLATFORM_ROOM_X, EVERY_SIDE, ranges.room),
        uniform(rng, streams.PLATFORM_ROOM_Y, EVERY_SIDE, ranges.room),
    )
    beyond = wp.vec2(wp.abs(goal[0]), wp.abs(goal[1])) - half - foot
    if wp.max(beyond) < ranges.clearance:
        return Block()
    return fixed_block(wp.vec2(0.0), half, uniform_range(rng, streams.BLOCK_HEIGHT, ranges.drop))


@wp.func
def sample_block(rng: RngStream, ranges: GroundRanges, foot: wp.vec2, goal: wp.vec3) -> Block:
    """Return a sampled block under the goal; none without room for its near side between the paws of start and goal.

    The near side is anywhere there, more often near than far (a third within a ninth of the room), across the axis
    along which the goal is farther.
    """
    along = wp.where(wp.abs(goal[0]) >= wp.abs(goal[1]), 0, 1)
    way = wp.abs(goal[along])
    nearest = foot[along] + EVERY_SIDE
    farthest = way - foot[along] - ranges.clearance
    if nearest > farthest:
        return Block()
    u = uniform(rng, streams.BLOCK_NEAR_SIDE, 0.0, 1.0)
    near = nearest + u * u * (farthest - nearest)
    far = way + foot[along] + uniform(rng, streams.BLOCK_FAR_ROOM, EVERY_SIDE, ranges.room)
    center = wp.vec2(goal[0], goal[1])
    center[along] = wp.sign(goal[along]) * 0.5 * (near + far)
    half = foot + wp.vec2(uniform(rng, streams.BLOCK_SIDE_ROOM, EVERY_SIDE, ranges.room))
    half[along] = 0.5 * (far - near)
    block = fixed_block(center, half, uniform_range(rng, streams.BLOCK_HEIGHT, ranges.rise))
    block.mass = real(uniform_range(rng, streams.BLOCK_MASS, ranges.mass))
    block.friction = real(uniform_range(rng, streams.BLOCK_FRICTION, ranges.friction))
    return block


@wp.func
def sample_ground(rng: RngStream, ranges: GroundRanges, foot: wp.vec2, goal: wp.vec3) -> Block:
    """Return a sampled platform, block or level ground (no block) of a standing start; goal [m]: world axes."""
    u = uniform(rng, streams.GROUND, 0.0, 1.0)
    if u < ranges.platform:
        return sample_platform(rng, ranges, foot, goal)
    if u < ranges.platform + ranges.block:
        return sample_block(rng, ranges, foot, goal)
    return Block()
