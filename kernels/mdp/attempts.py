"""Attempts at a draw of a robot's state: in turn in one thread, or on a GPU by a warp, 8 attempts of 4 legs each.

On a GPU the 32 threads of a world differ in `Draw.lane` alone, and reach every exchange together. On the CPU, where
several threads serve tests, they are a block (launch with `block_dim=32`) and take turns: each leaves its value in a
box, waits, and reads.
"""

import warp as wp

from ..scalar import vec3
from .random import Draw

wp.set_module_options({"enable_backward": False})

ATTEMPTS = wp.constant(8)
LANES = 32
"""Threads of a GPU that share a world's attempts."""

_FIRST = """
#if defined(__CUDA_ARCH__)
    if (lanes > 1)
        return static_cast<int>(__reduce_min_sync(0xffffffffu, static_cast<unsigned int>(attempt)));
#else
    if (lanes > 1) {
        static int box[32];
        box[WP_TILE_THREAD_IDX % 32] = attempt;
        WP_TILE_SYNC();
        int smallest = box[0];
        for (int i = 1; i < 32; ++i)
            smallest = wp::min(smallest, box[i]);
        WP_TILE_SYNC();
        return smallest;
    }
#endif
    return attempt;
"""
_ALL = """
#if defined(__CUDA_ARCH__)
    if (lanes > 1)
        return __all_sync(0xfu << (threadIdx.x & 28u), flag);
#else
    if (lanes > 1) {
        static bool box[32];
        box[WP_TILE_THREAD_IDX % 32] = flag;
        WP_TILE_SYNC();
        const int first = WP_TILE_THREAD_IDX % 32 / 4 * 4;
        const bool all = box[first] && box[first + 1] && box[first + 2] && box[first + 3];
        WP_TILE_SYNC();
        return all;
    }
#endif
    return flag;
"""
_FROM = """
#if defined(__CUDA_ARCH__)
    if (lanes > 1)
        return __shfl_sync(0xfu << (threadIdx.x & 28u), x, leg, 4);
#else
    if (lanes > 1) {
        static float box[32];
        box[WP_TILE_THREAD_IDX % 32] = x;
        WP_TILE_SYNC();
        const float value = box[WP_TILE_THREAD_IDX % 32 / 4 * 4 + leg];
        WP_TILE_SYNC();
        return value;
    }
#endif
    return x;
"""
_MEET = """
#if defined(__CUDA_ARCH__)
    if (lanes > 1)
        __syncwarp();
#else
    if (lanes > 1)
        WP_TILE_SYNC();
#endif
"""


@wp.func_native(_FIRST)
def least(attempt: int, lanes: int) -> int:
    """Return the smallest number, >= 0, among the threads of a world."""
    ...


@wp.func_native(_ALL)
def all_lanes(flag: bool, lanes: int) -> bool:
    """Return whether a flag is set in all threads of an attempt."""
    ...


@wp.func_native(_FROM)
def from_lane(x: float, leg: int, lanes: int) -> float:
    """Return the number that the thread of a leg has."""
    ...


@wp.func_native(_MEET)
def meet_lanes(lanes: int):
    """Wait for the threads of a world; each then sees what the others wrote."""
    ...


@wp.func
def first_attempt(draw: Draw) -> int:
    """Return the first attempt that a thread makes."""
    return draw.lane // 4


@wp.func
def attempt_step(draw: Draw) -> int:
    """Return how many attempts further a thread makes its next one."""
    return wp.max(draw.lanes // 4, 1)


@wp.func
def first_leg(draw: Draw) -> int:
    """Return the first leg that a thread draws."""
    return draw.lane % 4


@wp.func
def leg_step(draw: Draw) -> int:
    """Return how many legs further a thread draws its next one."""
    return wp.min(draw.lanes, 4)


@wp.func
def all_legs(draw: Draw, flag: bool) -> bool:
    """Return whether a flag, which each thread has for its legs, is set for all legs of an attempt."""
    return all_lanes(flag, draw.lanes)


@wp.func
def taken_first(draw: Draw, attempt: int) -> int:
    """Return the smallest attempt that was taken; attempt: that of the thread, `ATTEMPTS` if none was."""
    return least(attempt, draw.lanes)


@wp.func
def of_leg(draw: Draw, v: vec3, leg: int) -> vec3:
    """Return the vector of a leg; v: that of the thread's leg, or in a single thread of the leg asked for."""
    return vec3(from_lane(v[0], leg, draw.lanes), from_lane(v[1], leg, draw.lanes), from_lane(v[2], leg, draw.lanes))


@wp.func
def meet_attempts(draw: Draw):
    """Wait for the threads of a world; each then sees what the others wrote."""
    meet_lanes(draw.lanes)
