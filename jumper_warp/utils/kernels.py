"""Types of Warp functions and kernels, and parallel compilation of kernels."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any, Protocol, cast

import numpy as np
import warp as wp
from numpy.typing import NDArray
from warp._src.context import ModuleHasher  # what Warp itself compares to find a changed kernel

from jumper_warp.utils.progress import phase
from jumper_warp.utils.threads import available_threads

if TYPE_CHECKING:  # Warp annotates its decorators as if they returned the decorated function
    Function = wp.Function | Callable[..., Any]
    Kernel = wp.Kernel | Callable[..., None]
else:
    Function, Kernel = wp.Function, wp.Kernel


class KernelStruct(Protocol):
    """Instance of a `@wp.struct` of the kernels, whose fields only Warp can check."""

    def __getattr__(self, name: str, /) -> Any: ...

    def __setattr__(self, name: str, value: Any, /) -> None: ...


def records(structs: wp.array) -> NDArray[np.void]:
    """Copy a Warp array of structs to a structured NumPy array with the same fields; waits for the device."""
    return cast("NDArray[np.void]", structs.numpy())


def content_hash(*parts: Any) -> bytes:
    """Return a hash of the code of all Warp functions in nested tuples, with functions and constants that they use.

    A function has the same identity after a notebook's cell has defined a helper or a constant of it again.
    """
    hasher = ModuleHasher([], {})
    hashes = []
    rest = list(parts)
    while rest:
        part = rest.pop()
        if isinstance(part, tuple):
            rest += part
        elif isinstance(part, wp.Function):
            hashes.append(hasher.hash_function(part))
    return b"".join(hashes)


def load_kernels(kernels: Iterable[tuple[Kernel, int]], device: wp.Device) -> None:
    """Compile the modules of kernels in parallel, or load them from Warp's cache, and wait; see `loading_kernels`.

    Warp itself compiles a module at its first launch, one after the other.
    """
    with loading_kernels(kernels, device):
        pass


@contextmanager
def loading_kernels(kernels: Iterable[tuple[Kernel, int]], device: wp.Device) -> Iterator[None]:
    """Compile the modules of kernels, or load them from Warp's cache, in other threads while the block runs.

    The block must launch none of them. At its end this thread compiles too, until all are loaded. kernels: pairs of a
    kernel and its launch's threads per block (ignored on a CPU). Compiler errors propagate.
    """
    _ = device.context  # Warp creates a device's context and streams at the first use, which is not thread-safe
    variants = {(kernel.module, block if device.is_cuda else None): None for kernel, block in kernels}
    remaining = iter(list(variants))

    def load() -> None:
        """Load modules until none remains; all workers take them from one iterator."""
        for module, block in remaining:
            wp.force_load(device, [module], block, 0)

    with phase("compiling or loading kernels"), ThreadPoolExecutor(max(1, available_threads() - 1)) as pool:
        workers = [pool.submit(load) for _ in range(min(len(variants), max(1, available_threads() - 1)))]
        try:
            yield
            load()
            for worker in workers:
                worker.result()
        finally:
            for _ in remaining:  # skip the rest after an error
                pass
