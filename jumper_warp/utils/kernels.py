"""Types of Warp functions and kernels, and parallel compilation of kernels."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from functools import partial
from typing import TYPE_CHECKING, Any, cast

import numpy as np
import warp as wp
from numpy.typing import NDArray

from jumper_warp.utils.progress import phase
from jumper_warp.utils.threads import available_threads, run_in_parallel

if TYPE_CHECKING:  # Warp annotates its decorators as if they returned the decorated function
    Function = wp.Function | Callable[..., Any]
    Kernel = wp.Kernel | Callable[..., None]
else:
    Function, Kernel = wp.Function, wp.Kernel


def records(structs: wp.array) -> NDArray[np.void]:
    """Copy a Warp array of structs to a NumPy record array of its shape; synchronises with the device."""
    return cast("NDArray[np.void]", structs.numpy())


def load_kernels(kernels: Iterable[tuple[Kernel, int]], device: wp.Device) -> None:
    """Compile the modules of kernels in parallel, or load them from Warp's cache on disk.

    kernels: pairs of a kernel and its launch's threads per block (ignored on a CPU). Compiler errors propagate.
    """
    variants = {(kernel.module, block if device.is_cuda else None): None for kernel, block in kernels}
    loads = [partial(wp.force_load, device, [module], block, 0) for module, block in variants]
    with phase("compiling or loading kernels"):
        run_in_parallel(loads, available_threads())
