"""Durations in policy steps; 2^31 or more steps mean "never"."""

import warp as wp

NEVER = wp.constant(2147483520)  # [policy steps] of an event that never happens: largest float32 below 2^31


@wp.func
def whole_steps(steps: float) -> int:
    """Return a duration [policy steps], >= 0, rounded down; NEVER if it is larger, as a larger int32 does not exist."""
    return int(wp.min(steps, float(NEVER)))
