"""Progress display of long work on standard error: title, elapsed time and, if known, the time left."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial

from rich.console import Console
from rich.progress import BarColumn, Progress, TimeElapsedColumn, TimeRemainingColumn

from jumper_warp.utils.startup import open_standard_streams

_shown: Progress | None = None  # Display of the outermost phase, which shows the phases within it too


def format_duration(seconds: float) -> str:
    """Return a duration [s] as text such as `59 s`, `58 min` or `1 h 20 min`."""
    if seconds < 59.5:
        return f"{seconds:.0f} s"
    hours, minutes = divmod(round(seconds / 60.0), 60)
    return f"{hours} h {minutes} min" if hours else f"{minutes} min"


@contextmanager
def phase(title: str, total: int | None = None) -> Iterator[Callable[..., object]]:
    """Show title, elapsed time and progress of long work while the block runs, if standard error is a terminal.

    total: number of parts (default: unknown). Yields the function to call after each part, or with the number of parts
    that have been done since the last call. Phases may be nested. The display disappears at the end.
    """
    global _shown
    open_standard_streams()
    if not sys.stderr.isatty() or os.environ.get("RANK", "0") != "0":
        yield lambda parts=1: None
        return
    progress, outer = _shown, _shown
    if progress is None:
        columns = ("{task.description}", BarColumn(20), TimeElapsedColumn(), TimeRemainingColumn())
        # prints to another file than the terminal must not be redirected to it
        progress = Progress(*columns, console=Console(stderr=True), transient=True, redirect_stdout=sys.stdout.isatty())
        progress.start()
    _shown = progress
    task = progress.add_task(title, total=total)
    try:
        yield partial(progress.advance, task)
    finally:
        progress.remove_task(task)
        _shown = outer
        if outer is None:
            progress.stop()
