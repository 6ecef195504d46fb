"""The files that a run's figures go to: lines of JSON, and TensorBoard's events. Neither ever ends in half a record."""

from __future__ import annotations

import io
import json
import math
import os
import socket
import time
from contextlib import suppress
from pathlib import Path
from typing import Any

from jumper_warp.utils.files import write_whole


class WholeRecords:
    """A file that whole records are appended to, also after a full disk."""

    def __init__(self, path: Path) -> None:
        """Open the file, made if need be. Raises OSError: it cannot be written."""
        self.path = path
        self._file = path.open("ab", buffering=0)
        self._size = path.stat().st_size
        self._waiting = b""

    def append(self, record: bytes) -> None:
        """Append a record.

        Raises:
            OSError: The disk is full, say. The file is as before; the record is kept, and goes with the next one.
        """
        self._waiting += record
        written = 0
        try:
            while written < len(self._waiting):
                written += self._file.write(self._waiting[written:])
        except OSError as error:
            with suppress(OSError):
                self._file.truncate(self._size)
            error.filename = str(self.path)
            raise
        self._size, self._waiting = self._size + written, b""

    def close(self) -> None:
        """Close the file."""
        self._file.close()


class FiguresFile(WholeRecords):
    """One JSON object a line, in the order of the iterations."""

    def __init__(self, path: Path, iteration: int) -> None:
        """Open the file to go on after `iteration`: drop lines of later ones, half lines and what is no JSON.

        Raises:
            OSError: It cannot be read or written.
        """
        content = path.read_bytes() if path.is_file() else b""
        lines = content.splitlines()
        kept = [line for line in lines if _iteration_of(line) <= iteration]
        self.dropped = len(lines) - len(kept)
        """Lines that were."""
        whole = b"".join(line + b"\n" for line in kept)
        if whole != content:
            write_whole(path, whole)
        super().__init__(path)

    def add(self, iteration: int, figures: dict[str, float]) -> None:
        """Append the figures of an iteration, null for those that are not finite. Raises OSError as `append`."""
        values = {name: value if math.isfinite(value) else None for name, value in figures.items()}
        self.append(json.dumps({"iteration": iteration, **values}, allow_nan=False).encode() + b"\n")


class EventFile(WholeRecords):
    """TensorBoard's scalars, written at once where its own writer has a thread that fails with a traceback."""

    def __init__(self, folder: Path, iteration: int) -> None:
        """Begin a file in a run's folder that hides events after `iteration` in older ones.

        Raises:
            ImportError: TensorBoard is not installed.
            OSError: The file cannot be written.
        """
        from tensorboard.compat.proto import event_pb2, summary_pb2

        self._event, self._summary = event_pb2.Event, summary_pb2.Summary
        super().__init__(folder / f"events.out.tfevents.{int(time.time()):010d}.{socket.gethostname()}.{os.getpid()}")
        self._add(file_version="brain.Event:2")
        if iteration:
            start = event_pb2.SessionLog(status=event_pb2.SessionLog.START)
            self._add(step=iteration + 1, session_log=start)

    def add(self, iteration: int, figures: dict[str, float]) -> None:
        """Append the figures of an iteration. Raises OSError as `append`."""
        values = [self._summary.Value(tag=name, simple_value=value) for name, value in figures.items()]
        self._add(step=iteration, summary=self._summary(value=values))

    def _add(self, **fields: Any) -> None:
        from tensorboard.summary.writer.record_writer import RecordWriter

        record = io.BytesIO()
        RecordWriter(record).write(self._event(wall_time=time.time(), **fields).SerializeToString())
        self.append(record.getvalue())


def _iteration_of(line: bytes) -> float:
    """Return the iteration of a line of figures; infinity if it is none."""
    try:
        return int(json.loads(line)["iteration"])
    except (ValueError, KeyError, TypeError, RecursionError):
        return math.inf
