"""Stand-in for a full disk."""

import contextlib
import resource


@contextlib.contextmanager
def full_disk(size=0):
    """Context in which this process cannot write files beyond `size` bytes: writes fail partway."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
