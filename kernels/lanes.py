"""Exchange of values between the threads of a GPU warp that simulate one world.

A world has four threads (one per leg: FL, FR, BL, BR), or 32 (eight attempts of four); the leg index runs fastest. All
threads of a warp must execute every call together: place none behind `and` or `or`, or in a branch that some threads
skip. On the CPU, which only tests use, a block holds the threads of one world (`block_dim=4`, or 32).

Exchange through registers (shuffles and votes) is faster than through memory, and needs no barrier. `_exchange` builds
C++ snippets, which have no Python body.
"""

import warp as wp

from .scalar import mat33, quat, real, vec3


def _exchange(gpu: str, sent: str, received: str, threads: int = 4) -> str:
    """Return the C++ code by which threads of the same world exchange values, for CUDA and for the CPU.

    The code is `gpu` for CUDA; otherwise it writes `sent` to a box, waits, and reads `received`. gpu: CUDA statements
    that return the result. sent, received: C++ expressions; `received` may read all of `box[threads]`, which holds the
    value `sent` of every thread of a world.
    """
    return f"""
#if defined(__CUDA_ARCH__)
    {gpu}
#else
    static decltype({sent}) box[{threads}];
    const int lane = WP_TILE_THREAD_IDX % {threads};
    box[lane] = {sent};
    WP_TILE_SYNC();
    const auto received = {received};
    WP_TILE_SYNC();
    return received;
#endif
"""


_SUM = _exchange(
    "x += __shfl_xor_sync(0xffffffffu, x, 1); return x + __shfl_xor_sync(0xffffffffu, x, 2);",
    "x", "(box[0] + box[1]) + (box[2] + box[3])",
)  # fmt: skip
_MAX = _exchange(
    "x = wp::max(x, __shfl_xor_sync(0xffffffffu, x, 1)); return wp::max(x, __shfl_xor_sync(0xffffffffu, x, 2));",
    "x", "wp::max(wp::max(box[0], box[1]), wp::max(box[2], box[3]))",
)  # fmt: skip
_FROM = _exchange("return __shfl_sync(0xffffffffu, x, leg, 4);", "x", "box[leg]")
_FIRST = _exchange(
    "const unsigned int votes = __ballot_sync(0xffffffffu, flag);"
    "return wp::max(__ffs((votes >> (threadIdx.x & 28u)) & 15u) - 1, 0);",
    "flag", "box[0] ? 0 : box[1] ? 1 : box[2] ? 2 : box[3] ? 3 : 0",
)  # fmt: skip
_LEAST = _exchange(
    "return static_cast<int>(__reduce_min_sync(0xffffffffu, static_cast<unsigned int>(x)));",
    "x", "[&] { int least = box[0]; for (int y : box) least = wp::min(least, y); return least; }()", 32,
)  # fmt: skip
_ALL = _exchange(
    "return __all_sync(0xfu << (threadIdx.x & 28u), flag);",
    "flag", "box[lane & 28] && box[lane & 28 | 1] && box[lane & 28 | 2] && box[lane & 28 | 3]", 32,
)  # fmt: skip
_FROM_TRY = _exchange("return __shfl_sync(0xfu << (threadIdx.x & 28u), x, leg, 4);", "x", "box[lane & 28 | leg]", 32)
_STEP_THREADS = """
#if defined(__CUDA_ARCH__)
    x += __shfl_xor_sync(0xffffffffu, x, 4);
    x += __shfl_xor_sync(0xffffffffu, x, 8);
    x += __shfl_xor_sync(0xffffffffu, x, 16);
#endif
    return x;
"""
_ANY = """
#if defined(__CUDA_ARCH__)
    return __any_sync(0xffffffffu, flag);
#else
    return flag;
#endif
"""
_SYNC = """
#if defined(__CUDA_ARCH__)
    __syncwarp();
#else
    WP_TILE_SYNC();
#endif
"""


@wp.func_native(_SUM)
def sum_legs(x: real) -> real:
    """Return the sum of a value x over the four legs' threads of a world; all four get the same bits."""
    ...


@wp.func_native(_STEP_THREADS)
def sum_step_threads(x: real) -> real:
    """Return the sum of x over the eight threads of one leg, in a GPU warp that simulates one world with 8 x 4 threads.

    On a CPU it returns x.
    """
    ...


@wp.func_native(_MAX)
def max_legs(x: real) -> real:
    """Return the largest x among the four legs of a world; no x may be NaN."""
    ...


@wp.func_native(_FROM)
def from_leg(x: real, leg: int) -> real:
    """Return the value x of the thread of leg `leg` (0 to 3) of the same world."""
    ...


@wp.func_native(_FIRST)
def first_leg(flag: bool) -> int:
    """Return the smallest index (0 to 3) among a world's legs whose flag is true, 0 if none is."""
    ...


@wp.func_native(_LEAST)
def least_of_attempts(x: int) -> int:
    """Return the smallest x among the 32 threads (8 sampling attempts, 4 legs) of a world; every x must be >= 0."""
    ...


@wp.func_native(_ALL)
def all_of_attempt(flag: bool) -> bool:
    """Return whether the flag is true in all four threads of a sampling attempt; all of them must call it together."""
    ...


@wp.func_native(_FROM_TRY)
def from_leg_of_attempt(x: float, leg: int) -> float:
    """Return the x of leg `leg` (0 to 3) of the same sampling attempt, whose threads must make this call together."""
    ...


@wp.func_native(_ANY)
def any_world(flag: bool) -> bool:
    """Return whether the flag is set in any world of the warp; all threads of a world must pass the same flag.

    Worlds of a warp leave a loop together, since its exchanges need all threads.
    """
    ...


@wp.func_native(_SYNC)
def sync_lanes():
    """Synchronise the threads of a world; memory writes before it are visible to all of them after it."""
    ...


@wp.func
def sum_vec(v: vec3) -> vec3:
    """Return the sum of a vector v over the threads of the four legs of a world."""
    return vec3(sum_legs(v[0]), sum_legs(v[1]), sum_legs(v[2]))


@wp.func
def vec_from_leg(v: vec3, leg: int) -> vec3:
    """Return the vector v of the thread of leg `leg` (0 to 3) of the same world."""
    return vec3(from_leg(v[0], leg), from_leg(v[1], leg), from_leg(v[2], leg))


@wp.func
def mat_from_leg(m: mat33, leg: int) -> mat33:
    """Return the matrix m of the thread of leg `leg` (0 to 3) of the same world."""
    return mat33(
        from_leg(m[0, 0], leg), from_leg(m[0, 1], leg), from_leg(m[0, 2], leg),
        from_leg(m[1, 0], leg), from_leg(m[1, 1], leg), from_leg(m[1, 2], leg),
        from_leg(m[2, 0], leg), from_leg(m[2, 1], leg), from_leg(m[2, 2], leg),
    )  # fmt: skip


@wp.func
def sum_quat(q: quat) -> quat:
    """Return the sum of the components of a quaternion q over the four legs of a world, not normalised."""
    return quat(sum_legs(q[0]), sum_legs(q[1]), sum_legs(q[2]), sum_legs(q[3]))


@wp.func
def sum_symmetric(m: mat33) -> mat33:
    """Return the sum of a symmetric 3x3 matrix m over the four legs of a world; only its upper triangle is read."""
    xx, yy, zz = sum_legs(m[0, 0]), sum_legs(m[1, 1]), sum_legs(m[2, 2])
    xy, xz, yz = sum_legs(m[0, 1]), sum_legs(m[0, 2]), sum_legs(m[1, 2])
    return mat33(xx, xy, xz, xy, yy, yz, xz, yz, zz)


@wp.func
def sum_matrix(m: mat33) -> mat33:
    """Return the sum of a 3x3 matrix m, symmetric or not, over the four legs of a world."""
    return mat33(
        sum_legs(m[0, 0]), sum_legs(m[0, 1]), sum_legs(m[0, 2]),
        sum_legs(m[1, 0]), sum_legs(m[1, 1]), sum_legs(m[1, 2]),
        sum_legs(m[2, 0]), sum_legs(m[2, 1]), sum_legs(m[2, 2]),
    )  # fmt: skip
