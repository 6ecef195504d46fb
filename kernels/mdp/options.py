"""Options of the stage kernels."""

FAST = {"enable_backward": False, "fast_math": True}
"""Short code on a GPU: divisions, roots and exponentials to 2 units in the last place. The CPU's code stays exact."""
