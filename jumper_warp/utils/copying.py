"""Base class of objects that can be neither copied nor pickled."""

from typing import NoReturn


class Uncopied:
    """Base class of objects that hold Warp arrays and captured graphs, which can be neither copied nor pickled."""

    def __reduce__(self) -> NoReturn:
        """Raise TypeError, with what to do instead; `copy.copy`, `copy.deepcopy` and `pickle` call it."""
        raise TypeError(
            f"{type(self).__name__} can be neither copied nor pickled: it holds memory of a device; make another one "
            "with the same arguments, in a new process too (a TaskCfg can be pickled)"
        )
