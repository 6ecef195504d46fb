"""Constants and elementwise functions that several Triton kernels use."""

import triton
import triton.language as tl

HALF_LOG_TAU = tl.constexpr(0.9189385332046727)  # log(2 π) / 2
INFINITY = tl.constexpr(float("inf"))


@triton.jit
def finite_or_zero(x):
    """Return x with NaN and infinite entries set to 0."""
    return tl.where(tl.abs(x) < INFINITY, x, 0.0)
