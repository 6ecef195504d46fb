"""Compilation of Warp kernels side by side, instead of one module after the other at their first launches."""

from __future__ import annotations

from collections.abc import Iterable
from functools import partial

import warp as wp

from jumper_warp.utils.threads import available_threads, run_side_by_side


def load_kernels(kernels: Iterable[tuple[wp.Kernel, int]], device: wp.Device) -> None:
    """Compile, or read from Warp's cache on disk, the modules of kernels that are launched with these block sizes.

    Raises what the compiler raises.
    """
    variants = {(kernel.module, block if device.is_cuda else None): None for kernel, block in kernels}
    loads = [partial(wp.force_load, device, [module], block, 0) for module, block in variants]
    run_side_by_side(loads, available_threads())
