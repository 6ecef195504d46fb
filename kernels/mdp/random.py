"""Counter-based random streams: a number depends on seed, purpose, world, step count, stream and index only.

There is no state to store or advance: any thread can compute any number, in any order, so that results depend neither
on the device nor on the number of threads.

The index of a number is hashed into the 32 bits of its stream: state = pcg(stream + pcg(index)). Purposes (training,
tuning, selection, reporting) have disjoint ranges of indices. Two streams s and t of different purposes have the same
state for number i only if s - t = pcg(index of i for t) - pcg(index of i for s), modulo 2^32. These differences differ
for all i below 20,000, so the streams share at most one number, whatever their seeds, worlds and step counts are.
"""

import warp as wp

# numbers of streams
RESET = wp.constant(1)
COMMAND = wp.constant(2)
OBSERVATION = wp.constant(100)  # plus the index of the observation group
EVENT = wp.constant(1000)  # plus 100 times the stage (`mdp.events`) and the index of the event

# indices in a stream; tasks and events use those from 0 on
INDICES = wp.constant(1 << 28)  # size of the range of indices of each purpose
INTERVAL = wp.constant(-1)  # time until an interval event is due next
ANY_LEVEL = wp.constant(-2)  # curriculum level of a world that passed the last one


@wp.struct
class RngStream:
    """A random stream of one world; `uniform(rng, i, ...)` depends on `seed`, `start` and index i only."""

    world: int  # index of the world whose quantities are sampled
    seed: wp.uint32
    start: int  # start of the range of indices of its purpose
    lane: int  # index of this thread among those that share the work of a world
    lanes: int  # number of these threads


@wp.func
def step_key(seed: int, world: int, step_count: int) -> wp.uint32:
    """Return the key from which all random streams of a world in one policy step follow; step_count: steps made."""
    return wp.rand_init(int(wp.rand_init(seed, world)), step_count)


@wp.func
def stream_at(key: wp.uint32, purpose: int, world: int, stream: int) -> RngStream:
    """Return random stream number `stream` of a world in one policy step, whose `step_key` is `key`.

    It is for a thread that samples alone (`lanes` 1). purpose: index in `jumper_warp.utils.streams.PURPOSES`.
    """
    rng = RngStream()
    rng.world = world
    rng.lanes = 1
    rng.seed = wp.rand_init(int(key), stream)
    rng.start = purpose * INDICES
    return rng


@wp.func
def make_stream(seed: int, purpose: int, world: int, step_count: int, stream: int) -> RngStream:
    """Return random stream number `stream` of a world that has made `step_count` policy steps (see `stream_at`)."""
    return stream_at(step_key(seed, world, step_count), purpose, world, stream)


@wp.func
def fold_in(rng: RngStream, i: int) -> RngStream:
    """Return a new random stream that is derived from another and an index, independent for every i.

    Attempts at a start state, for example, use the same indices in streams of their own. 7919 keeps their
    seeds apart from the states of the stream's own numbers.
    """
    branch = rng
    branch.seed = wp.rand_init(int(rng.seed), 7919 + i)
    return branch


@wp.func
def uniform(rng: RngStream, i: int, lower: float, upper: float) -> float:
    """Return the i-th random number of a stream, uniform in [lower, upper)."""
    return lower + (upper - lower) * wp.randf(wp.rand_init(int(rng.seed), rng.start + i))


@wp.func
def uniform_range(rng: RngStream, i: int, pair: wp.vec2) -> float:
    """Return the i-th random number of a stream, uniform in [pair[0], pair[1])."""
    return uniform(rng, i, pair[0], pair[1])


@wp.func
def normal(rng: RngStream, i: int) -> float:
    """Return the i-th random number of a stream, standard normal."""
    return wp.randn(wp.rand_init(int(rng.seed), rng.start + i))


@wp.func
def clamped_normal(rng: RngStream, i: int) -> float:
    """Return the i-th random number of a stream, standard normal, clamped to [-1, 1]."""
    return wp.clamp(normal(rng, i), -1.0, 1.0)
