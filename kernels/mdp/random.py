"""Random numbers that depend on seed, world, clock and stream alone: whatever else is drawn changes none of them."""

import warp as wp

# streams; events and observation groups have one each from these on
RESET = wp.constant(1)
COMMAND = wp.constant(2)
OBSERVATION = wp.constant(100)
EVENT = wp.constant(1000)  # a hundred for each stage

# numbers of a stream beside those of tasks and events
INTERVAL = wp.constant(-1)  # until the next time of an event
ANY_LEVEL = wp.constant(-2)  # of the curriculum, of a world past the last


@wp.struct
class RngStream:
    """Independent random numbers of one world."""

    world: int
    seed: wp.uint32
    lane: int  # which of the threads that share the work of a world this is
    lanes: int  # how many these are


@wp.func
def step_key(seed: int, world: int, step_count: int) -> wp.uint32:
    """Return what the numbers of all streams at one moment begin with; clock: policy steps that the world has made."""
    return wp.rand_init(int(wp.rand_init(seed, world)), step_count)


@wp.func
def stream_at(moment: wp.uint32, world: int, stream: int) -> RngStream:
    """Return the numbers of a stream at a moment."""
    rng = RngStream()
    rng.world = world
    rng.lanes = 1
    rng.seed = wp.rand_init(int(moment), stream)
    return rng


@wp.func
def make_stream(seed: int, world: int, step_count: int, stream: int) -> RngStream:
    """Return the numbers of a stream; clock: policy steps that the world has made."""
    return stream_at(step_key(seed, world, step_count), world, stream)


@wp.func
def fold_in(rng: RngStream, i: int) -> RngStream:
    """Return other numbers, independent for every i."""
    other = rng
    other.seed = wp.rand_init(int(rng.seed), 7919 + i)
    return other


@wp.func
def uniform(rng: RngStream, i: int, lower: float, upper: float) -> float:
    """Return the i-th number, uniform in [lower, upper)."""
    return lower + (upper - lower) * wp.randf(wp.rand_init(int(rng.seed), i))


@wp.func
def uniform_range(rng: RngStream, i: int, pair: wp.vec2) -> float:
    """Return the i-th number, uniform in a pair (lower, upper)."""
    return uniform(rng, i, pair[0], pair[1])


@wp.func
def clamped_normal(rng: RngStream, i: int) -> float:
    """Return the i-th number, standard normal, cut at one standard deviation."""
    return wp.clamp(wp.randn(wp.rand_init(int(rng.seed), i)), -1.0, 1.0)
