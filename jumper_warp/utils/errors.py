"""Base class of errors in user input, and suggestions for misspelt names in their messages."""

import re
from collections.abc import Iterable


class InputError(ValueError):
    """Error for invalid input of the user; the message is one line with the expected and the actual value.

    Commands and experiments print it and exit with code 2; any other exception propagates with its traceback.
    """

    def __init__(self, message: str) -> None:
        """Store the message of the error. message: text in which runs of whitespace become one space."""
        super().__init__(" ".join(message.split()))


MEMORY_MESSAGES = re.compile(r"Failed to allocate \d+ bytes|out of memory|can't allocate memory", re.IGNORECASE)
"""Messages of Warp, CUDA and torch's CPU allocator about exhausted memory."""


def is_out_of_memory(error: BaseException) -> bool:
    """Return whether an exception of Python, NumPy, torch or Warp is about exhausted memory."""
    names = {kind.__name__ for kind in type(error).__mro__}
    known = names & {"MemoryError", "OutOfMemoryError"}
    return bool(known) or (isinstance(error, RuntimeError) and MEMORY_MESSAGES.search(str(error)) is not None)


def suggestion(name: str, known: Iterable[str]) -> str:
    """Return the end of an error message, "; did you mean 'x'?", for a misspelt name, or "" if none is close."""
    import difflib

    spellings = {word.lower().replace("_", "-"): word for word in known}
    close = difflib.get_close_matches(name.lower().replace("_", "-"), spellings, n=1)
    return f"; did you mean {spellings[close[0]]!r}?" if close else ""
