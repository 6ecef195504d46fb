"""Counter-based random streams: a number depends on seed, world, step count, stream and index, on nothing else."""

import warp as wp

# streams; events and observation groups have one each, numbered from these on
RESET = wp.constant(1)
COMMAND = wp.constant(2)
OBSERVATION = wp.constant(100)
EVENT = wp.constant(1000)  # a hundred for each stage

# indices in a stream beside those of tasks and events
INTERVAL = wp.constant(-1)  # until the next time of an event
ANY_LEVEL = wp.constant(-2)  # of the curriculum, of a world past the last


@wp.struct
class RngStream:
    """A random stream of one world; `uniform(rng, i, ...)` is a pure function of stream and index i."""

    world: int
    seed: wp.uint32
    lane: int  # index of this thread among those that share the work of a world
    lanes: int  # number of these threads


@wp.func
def step_key(seed: int, world: int, step_count: int) -> wp.uint32:
    """Return the seed of all streams of a world in one policy step; step_count: policy steps made."""
    return wp.rand_init(int(wp.rand_init(seed, world)), step_count)


@wp.func
def stream_at(moment: wp.uint32, world: int, stream: int) -> RngStream:
    """Return a stream of a policy step; step_key: see `step_key`."""
    rng = RngStream()
    rng.world = world
    rng.lanes = 1
    rng.seed = wp.rand_init(int(moment), stream)
    return rng


@wp.func
def make_stream(seed: int, world: int, step_count: int, stream: int) -> RngStream:
    """Return a stream of a world; step_count: policy steps that the world has made."""
    return stream_at(step_key(seed, world, step_count), world, stream)


@wp.func
def fold_in(rng: RngStream, i: int) -> RngStream:
    """Return a stream derived from another one, independent for every i (as `jax.random.fold_in`)."""
    other = rng
    other.seed = wp.rand_init(int(rng.seed), 7919 + i)
    return other


@wp.func
def uniform(rng: RngStream, i: int, lower: float, upper: float) -> float:
    """Return the i-th number of a stream, uniform in [lower, upper)."""
    return lower + (upper - lower) * wp.randf(wp.rand_init(int(rng.seed), i))


@wp.func
def uniform_range(rng: RngStream, i: int, pair: wp.vec2) -> float:
    """Return the i-th number of a stream, uniform in a pair (lower, upper)."""
    return uniform(rng, i, pair[0], pair[1])


@wp.func
def clamped_normal(rng: RngStream, i: int) -> float:
    """Return the i-th number of a stream, standard normal, clamped to [-1, 1]."""
    return wp.clamp(wp.randn(wp.rand_init(int(rng.seed), i)), -1.0, 1.0)
