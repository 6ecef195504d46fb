"""Base class of errors in user input."""


class InputError(ValueError):
    """Invalid input; the message is one line with the expected and the actual value.

    Commands and experiments print it and exit with code 2; any other exception propagates with its traceback.
    """

    def __init__(self, message: str) -> None:
        """message: text in which runs of whitespace become one space."""
        super().__init__(" ".join(message.split()))
