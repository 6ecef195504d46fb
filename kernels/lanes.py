"""Exchange between the threads of a GPU's warp that share a world: four, one per leg, or 32, eight attempts of four.

Legs are neighbours, leg fastest, and all threads of a warp must reach every call together: none may stand behind an
`and` or `or`, which may skip them, or in a branch that not all take. On the CPU, where these
functions serve tests, a block is the threads of one world (launch with `block_dim=4`, or 32).
"""

import warp as wp

from .scalar import mat33, quat, real, vec3


def _exchange(gpu: str, sent: str, received: str, threads: int = 4) -> str:
    """Return the code of an exchange. Threads of a CPU's block take turns: each fills its box, waits, and reads."""
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
_FROM_OWN = _exchange("return __shfl_sync(0xfu << (threadIdx.x & 28u), x, leg, 4);", "x", "box[lane & 28 | leg]", 32)
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
_MEET = """
#if defined(__CUDA_ARCH__)
    __syncwarp();
#else
    WP_TILE_SYNC();
#endif
"""


@wp.func_native(_SUM)
def sum_legs(x: real) -> real:
    """Return the sum over the legs of a world, the same bits in each thread."""
    ...


@wp.func_native(_STEP_THREADS)
def sum_step_threads(x: real) -> real:
    """Return the sum over threads of a leg where a warp has one world, its threads being (8, 4); itself on a CPU."""
    ...


@wp.func_native(_MAX)
def max_legs(x: real) -> real:
    """Return the largest value among the legs of a world; x: not NaN."""
    ...


@wp.func_native(_FROM)
def from_leg(x: real, leg: int) -> real:
    """Return the value of one leg of the world."""
    ...


@wp.func_native(_FIRST)
def first_leg(flag: bool) -> int:
    """Return the first leg of the world whose flag is set, 0 if none is."""
    ...


@wp.func_native(_LEAST)
def least_of_attempts(x: int) -> int:
    """Return the smallest number, >= 0, among the 32 threads of a world."""
    ...


@wp.func_native(_ALL)
def all_of_attempt(flag: bool) -> bool:
    """Return whether a flag is set in all four threads of an attempt, which reach this call together."""
    ...


@wp.func_native(_FROM_OWN)
def from_leg_of_attempt(x: float, leg: int) -> float:
    """Return the value of one leg of the attempt, whose four threads reach this call together."""
    ...


@wp.func_native(_ANY)
def any_world(flag: bool) -> bool:
    """Return whether a flag, the same for all legs of a world, is set in any world that must wait for this one."""
    ...


@wp.func_native(_MEET)
def sync_lanes():
    """Synchronise the threads of a world; memory writes before it are visible to all of them after it."""
    ...


@wp.func
def sum_vec(v: vec3) -> vec3:
    """Return the sum of vectors over the legs."""
    return vec3(sum_legs(v[0]), sum_legs(v[1]), sum_legs(v[2]))


@wp.func
def vec_from_leg(v: vec3, leg: int) -> vec3:
    """Return the vector of one leg."""
    return vec3(from_leg(v[0], leg), from_leg(v[1], leg), from_leg(v[2], leg))


@wp.func
def mat_from_leg(m: mat33, leg: int) -> mat33:
    """Return the matrix of one leg."""
    return mat33(
        from_leg(m[0, 0], leg), from_leg(m[0, 1], leg), from_leg(m[0, 2], leg),
        from_leg(m[1, 0], leg), from_leg(m[1, 1], leg), from_leg(m[1, 2], leg),
        from_leg(m[2, 0], leg), from_leg(m[2, 1], leg), from_leg(m[2, 2], leg),
    )  # fmt: skip


@wp.func
def sum_quat(q: quat) -> quat:
    """Return the sum of the entries of quaternions over the legs."""
    return quat(sum_legs(q[0]), sum_legs(q[1]), sum_legs(q[2]), sum_legs(q[3]))


@wp.func
def sum_symmetric(m: mat33) -> mat33:
    """Return the sum of symmetric matrices over the legs."""
    xx, yy, zz = sum_legs(m[0, 0]), sum_legs(m[1, 1]), sum_legs(m[2, 2])
    xy, xz, yz = sum_legs(m[0, 1]), sum_legs(m[0, 2]), sum_legs(m[1, 2])
    return mat33(xx, xy, xz, xy, yy, yz, xz, yz, zz)


@wp.func
def sum_matrix(m: mat33) -> mat33:
    """Return the sum of matrices over the legs."""
    return mat33(
        sum_legs(m[0, 0]), sum_legs(m[0, 1]), sum_legs(m[0, 2]),
        sum_legs(m[1, 0]), sum_legs(m[1, 1]), sum_legs(m[1, 2]),
        sum_legs(m[2, 0]), sum_legs(m[2, 1]), sum_legs(m[2, 2]),
    )  # fmt: skip
