"""TensorBoard's event file of a run, written without a thread: a failure is an error of the call, not a traceback."""

from __future__ import annotations

import importlib
import socket
import time
from pathlib import Path
from typing import Any

from jumper_warp.rl.run_folder import flat_settings
from jumper_warp.utils.files import Json

BUFFER = 2**20  # [byte] More than the events of an iteration


class EventsFile:
    """File of TensorBoard events of a training; `add` writes them, also those of the constructor."""

    def __init__(self, folder: Path, iteration: int, config: Json) -> None:
        """Create the file in a run's folder, with settings as hparams; hide events after `iteration` in older files.

        config: JSON-ready configuration of the run. Raises OSError: the file cannot be created.
        """
        from tensorboard.summary.writer.record_writer import RecordWriter
        from torch.utils.tensorboard.summary import hparams

        self._proto: Any = importlib.import_module("tensorboard.compat.proto.event_pb2")
        name = f"events.out.tfevents.{time.time():.0f}.{socket.gethostname()}.{time.time_ns()}"
        self._records = RecordWriter((folder / name).open("xb", buffering=BUFFER))
        self._write(file_version="brain.Event:2")
        if iteration:
            self._write(step=iteration + 1, session_log={"status": self._proto.SessionLog.START})
        settings = {key: value for key, value in flat_settings(config).items() if isinstance(value, bool | int | float)}
        for summary in hparams(settings, {"Metrics/success": 0.0}):
            self._write(summary=summary)

    def add(self, iteration: int, metrics: dict[str, float]) -> None:
        """Write the metrics of an iteration by name. Raises OSError, such as on a full disk."""
        values = [{"tag": name, "simple_value": value} for name, value in metrics.items()]
        self._write(step=iteration, summary={"value": values})
        self._records.flush()

    def close(self) -> None:
        """Close the file. Raises OSError: events cannot be written."""
        self._records.close()

    def _write(self, **fields: Any) -> None:
        """Write an event to the buffer; fields: those of TensorBoard's `Event`."""
        self._records.write(self._proto.Event(wall_time=time.time(), **fields).SerializeToString())
