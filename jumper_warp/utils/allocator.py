"""The C library's allocator: memory that is given back to the system has to be made again, page by page."""

from __future__ import annotations

import ctypes

TRIM_THRESHOLD, MMAP_THRESHOLD = -1, -3
"""Options of glibc's mallopt (malloc.h)."""
KEPT, LARGEST = 1 << 30, 32 << 20
"""[B] What may stay free at the end of the heap, and the largest block from there; glibc allows no larger."""


def keep_freed_memory() -> bool:
    """Let this process keep up to 1 GiB of what it has freed; return whether the C library could be told.

    Without it every temporary array of a minibatch may cost as many page faults as it has pages.
    """
    try:
        mallopt = ctypes.CDLL(None).mallopt
    except (AttributeError, OSError):  # not glibc
        return False
    return mallopt(TRIM_THRESHOLD, KEPT) == 1 and mallopt(MMAP_THRESHOLD, LARGEST) == 1
