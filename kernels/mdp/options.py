"""Warp module options of the kernels of a policy step."""

FAST = {"enable_backward": False, "fast_math": True}
"""Warp module options; fast_math: GPU divisions, roots, exponentials are exact to 2 units in the last place."""
