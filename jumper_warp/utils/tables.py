"""Printing of tables to the terminal."""

import io

from rich.console import Console
from rich.table import Table

WIDTH = 80  # Characters in a line of a printed table


def print_table(table: Table) -> None:
    """Print a table of at most WIDTH characters a line; a closed pipe raises BrokenPipeError."""
    text = io.StringIO()  # rich itself exits with 1 when the reader closes the pipe
    Console(file=text, width=WIDTH, highlight=False).print(table)
    print("\n".join(line.rstrip() for line in text.getvalue().splitlines()))
