"""Base class of errors in user input, and the end of such a message that names what the user may have meant."""

from collections.abc import Iterable


class InputError(ValueError):
    """Invalid input; the message is one line with the expected and the actual value.

    Commands and experiments print it and exit with code 2; any other exception propagates with its traceback.
    """

    def __init__(self, message: str) -> None:
        """message: text in which runs of whitespace become one space."""
        super().__init__(" ".join(message.split()))


def suggestion(name: str, known: Iterable[str]) -> str:
    """Return "; did you mean 'x'?" with the known name most like a misspelt one, or "" if none is close."""
    import difflib

    spellings = {word.lower().replace("_", "-"): word for word in known}
    close = difflib.get_close_matches(name.lower().replace("_", "-"), spellings, n=1)
    return f"; did you mean {spellings[close[0]]!r}?" if close else ""
