"""Attempts at a draw of a robot's state: in turn in one thread, or on a GPU by a warp, 8 attempts of 4 legs each.

On a GPU the 32 threads of a world differ in `Draw.lane` alone, and reach every exchange together (see `lanes`).
"""

import warp as wp

from ..lanes import all_of_attempt, from_leg_of_attempt, least_of_attempts, meet
from ..scalar import vec3
from .random import Draw

wp.set_module_options({"enable_backward": False})

ATTEMPTS = wp.constant(8)
LANES = 32
"""Threads of a GPU that share a world's attempts."""


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
    if draw.lanes > 1:
        return all_of_attempt(flag)
    return flag


@wp.func
def taken_first(draw: Draw, attempt: int) -> int:
    """Return the smallest attempt that was taken; attempt: that of the thread, `ATTEMPTS` if none was."""
    if draw.lanes > 1:
        return least_of_attempts(attempt)
    return attempt


@wp.func
def of_leg(draw: Draw, v: vec3, leg: int) -> vec3:
    """Return the vector of a leg; v: that of the thread's leg, or in a single thread of the leg asked for."""
    if draw.lanes > 1:
        return vec3(
            from_leg_of_attempt(v[0], leg), from_leg_of_attempt(v[1], leg), from_leg_of_attempt(v[2], leg)
        )  # fmt: skip
    return v


@wp.func
def meet_attempts(draw: Draw):
    """Wait for the threads of a world; each then sees what the others wrote."""
    if draw.lanes > 1:
        meet()
