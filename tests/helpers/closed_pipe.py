"""A standard output whose reader has closed the pipe."""

import os
from contextlib import contextmanager, redirect_stdout


@contextmanager
def closed_pipe():
    """Make standard output a pipe whose reader has closed it, as `head` does."""
    reader, writer = os.pipe()
    os.close(reader)
    with open(writer, "w", buffering=1, encoding="utf-8") as file, redirect_stdout(file):
        yield
