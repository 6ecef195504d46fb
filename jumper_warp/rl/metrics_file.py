"""The file of a run's metrics: one JSON object a line, in the order of the iterations; it never ends in half a line."""

from __future__ import annotations

import json
import math
from contextlib import suppress
from pathlib import Path

from jumper_warp.utils.files import write_atomically


class MetricsFile:
    """Lines of metrics that are appended whole, also after a full disk."""

    def __init__(self, path: Path, iteration: int) -> None:
        """Open the file to continue after `iteration`: drop lines of later ones, half lines and what is no JSON.

        Raises OSError: it cannot be read or written.
        """
        content = path.read_bytes() if path.is_file() else b""
        lines = content.splitlines()
        kept = [line for line in lines if _iteration_of(line) <= iteration]
        self.path = path
        self.dropped = len(lines) - len(kept)
        """Lines that were."""
        whole = b"".join(line + b"\n" for line in kept)
        if whole != content:
            write_atomically(path, whole)
        self._file = path.open("ab", buffering=0)
        self._size = len(whole)
        self._waiting = b""

    def add(self, iteration: int, metrics: dict[str, float]) -> None:
        """Append the metrics of an iteration, null for those that are not finite.

        Raises OSError: the disk is full, say. The file is unchanged; the line is kept, and written with the next one.
        """
        values = {name: value if math.isfinite(value) else None for name, value in metrics.items()}
        self._waiting += json.dumps({"iteration": iteration, **values}, allow_nan=False).encode() + b"\n"
        written = 0
        try:
            while written < len(self._waiting):
                written += self._file.write(self._waiting[written:])
        except OSError:
            with suppress(OSError):
                self._file.truncate(self._size)
            raise
        self._size, self._waiting = self._size + written, b""

    def close(self) -> None:
        """Close the file."""
        self._file.close()


def _iteration_of(line: bytes) -> float:
    """Return the iteration of a line of metrics; infinity if it is none."""
    try:
        return int(json.loads(line)["iteration"])
    except (ValueError, KeyError, TypeError, RecursionError):
        return math.inf
