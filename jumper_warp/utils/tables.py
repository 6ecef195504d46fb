"""Printing of tables to the terminal."""

import io

from rich.console import Console
from rich.table import Table

WIDTH = 80  # Characters in a line of a printed table


def table_lines(table: Table) -> list[str]:
    """Return a table as lines of text of at most WIDTH characters."""
    text = io.StringIO()
    Console(file=text, width=WIDTH, highlight=False).print(table)
    return [line.rstrip() for line in text.getvalue().splitlines()]


def print_table(table: Table) -> None:
    """Print a table of at most WIDTH characters a line; a closed pipe raises BrokenPipeError."""
    print("\n".join(table_lines(table)))  # rich itself exits with 1 when the reader closes the pipe
