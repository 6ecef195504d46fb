"""Settings of glibc's allocator that keep freed memory, which avoids page faults on the next allocation."""

from __future__ import annotations

import ctypes

TRIM_THRESHOLD, MMAP_THRESHOLD = -1, -3  # Options of glibc's mallopt (malloc.h)
MAX_FREE, MAX_HEAP_BLOCK = 1 << 30, 32 << 20
"""[B] Free memory kept at the top of the heap, and the largest block allocated from the heap (glibc's maximum)."""


def keep_freed_memory() -> bool:
    """Configure glibc to keep up to 1 GiB of this process's freed memory; return whether glibc accepted the settings.

    With glibc's defaults every temporary array of a minibatch may cost one page fault per page.
    """
    try:
        mallopt = ctypes.CDLL(None).mallopt
    except (AttributeError, OSError):  # not glibc
        return False
    return mallopt(TRIM_THRESHOLD, MAX_FREE) == 1 and mallopt(MMAP_THRESHOLD, MAX_HEAP_BLOCK) == 1
