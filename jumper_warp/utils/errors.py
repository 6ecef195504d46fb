"""The base of every error that is this project's word on what it was given."""


class InputError(ValueError):
    """Something that was given cannot be used. The message is one line: what was expected, and what came.

    Commands and experiments print it and exit; any other exception is a fault and keeps its traceback.
    """

    def __init__(self, message: str) -> None:
        super().__init__(" ".join(message.split()))
