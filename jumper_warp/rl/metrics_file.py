"""Metrics file of a run: one JSON object per line, in the order of the iterations, without partial lines."""

from __future__ import annotations

import json
import math
import sys
from contextlib import suppress
from pathlib import Path

from jumper_warp.utils.errors import InputError
from jumper_warp.utils.files import Json, existing_file, parse_json, read_file, write_atomically

MOST = 1.0e300  # Bound of logged values, of which means are finite
METRICS_FILE = "metrics.jsonl"  # File in a run's folder, with one JSON object per logged iteration


class MetricsFile:
    """Metrics file of a training that appends whole lines or nothing; a failed line is written with the next one."""

    def __init__(self, path: Path, iteration: float) -> None:
        """Open the metrics file to continue after `iteration`; later iterations and malformed lines are removed.

        Raises InputError: the path is no regular file. OSError: the file cannot be read or written.
        """
        content = existing_file(path, "metrics of a run", sys.maxsize).read_bytes() if path.exists() else b""
        lines = content.splitlines()
        kept = [line for line in lines if logged_line(line).get("iteration", math.inf) <= iteration]
        self.path = path
        self.dropped = len(lines) - len(kept)  # Number of removed lines
        valid_content = b"".join(line + b"\n" for line in kept)
        if valid_content != content:
            write_atomically(path, valid_content)
        self._file = path.open("a+b", buffering=0)
        self._size = len(valid_content)
        self._pending = b""

    def add(self, iteration: int, metrics: dict[str, float]) -> None:
        """Append the metrics of an iteration, with null for non-finite values.

        Raises OSError, e.g. on a full disk: the file is unchanged, and the line is written with the next one.
        """
        values = {name: value if math.isfinite(value) else None for name, value in metrics.items()}
        if self._pending:  # a write failed, and perhaps the removal of its partial line too
            self._file.truncate(self._size)
        self._pending += json.dumps({"iteration": iteration, **values}, allow_nan=False).encode() + b"\n"
        written = 0
        try:
            while written < len(self._pending):
                written += self._file.write(self._pending[written:])
        except OSError:
            with suppress(OSError):
                self._file.truncate(self._size)
            raise
        self._size, self._pending = self._size + written, b""

    def close(self) -> None:
        """Close the file."""
        self._file.close()


def logged_line(line: bytes) -> Json:
    """Return the metrics in a line of a metrics file by name, None for undefined ones; empty: it is malformed."""
    with suppress(InputError):
        metrics = parse_json(line, METRICS_FILE)
        if isinstance(metrics, dict) and isinstance(metrics.get("iteration"), int):
            numbers = [0.0 if value is None else value for value in metrics.values()]
            return metrics if all(isinstance(each, int | float) and abs(each) < MOST for each in numbers) else {}
    return {}


def last_metrics(run: Path) -> Json:
    """Return the last line that a training logged, as a dict; empty: there is none, or it is malformed."""
    with suppress(ValueError, IndexError, OSError):
        return logged_line(read_file(run / METRICS_FILE, "metrics of a run").splitlines()[-1])
    return {}
