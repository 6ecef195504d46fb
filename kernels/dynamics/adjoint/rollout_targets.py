"""Reverse pass of a rollout without gradients w.r.t. the robot's parameters: a faster `rollout_adjoint`, for plans."""

import warp as wp

from ..trajectory import CPU_FLAGS
from .rollout_adjoint import make_reverse_kernel

wp.set_module_options({"enable_backward": False, "cpu_compiler_flags": f"{CPU_FLAGS} -ffp-contract=fast"})

reverse_targets_kernel = make_reverse_kernel(__name__, by_parameters=False)
