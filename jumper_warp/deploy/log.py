"""Log of a run: every tick as a record of `runtime.TICK`, and every frame in a file of python-can."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import can
import numpy as np

from jumper_warp.deploy.bundle import FILE, Bundle
from jumper_warp.deploy.runtime import RATES, TICK, Request, Runtime
from jumper_warp.deploy.sensors import MotionCapture
from jumper_warp.utils.errors import InputError
from jumper_warp.utils.files import read_file, read_json

TICKS, ABOUT = "ticks.bin", "log.json"
VERSION = 1
CONTAINER = 4096  # [bytes] that BLF compresses at once, in 0.1 ms; its own 128 kB delay a tick by 3 ms


class Log:
    """Files of a run in a folder: ticks.bin, log.json, deploy.yaml and the frames."""

    def __init__(self, folder: Path, bundle: Bundle, rate: int, frames: str = "frames.blf", **options: bool) -> None:
        """Create the files; frames: file name, .asc, .blf or .csv.

        options: `capture`, whether the source is a `MotionCapture`, and `dry_run` of the `Runtime`.
        Raises FileExistsError: the folder has a log.
        """
        folder.mkdir(parents=True, exist_ok=True)
        self._ticks = (folder / TICKS).open("xb")
        about = {"version": VERSION, "rate": rate, "tick_bytes": TICK.itemsize, **options}
        (folder / ABOUT).write_text(json.dumps(about), encoding="utf-8")
        (folder / FILE).write_bytes((bundle.folder / FILE).read_bytes())
        self._frames: Any = can.Logger(str(folder / frames))
        self._frames.max_container_size = CONTAINER
        self.full = False  # whether a write has failed; then the robot continues without a log

    def tick(self, record: np.ndarray) -> None:
        """Write the record of a tick."""
        self._write(self._ticks.write, record.tobytes())

    def frame(self, message: can.Message) -> None:
        """Write a frame, for `Link`."""
        self._write(self._frames, message)

    def _write(self, write: Callable[[Any], object], data: Any) -> None:
        """Write data; a full disk ends the log, not the run."""
        if not self.full:
            try:
                write(data)
            except OSError as error:
                self.full = True
                print(f"the log ends, the robot continues: {error}", file=sys.stderr)

    def close(self) -> None:
        """Close the files. Raises OSError: the disk is full."""
        self._ticks.close()
        self._frames.stop()


def read_log(folder: Path) -> tuple[np.ndarray, dict[str, Any]]:
    """Return the ticks of a log, records of TICK, and its log.json. Raises InputError: it is damaged."""
    about = read_json(folder / ABOUT, "log of a robot")
    known = {"version": [VERSION], "tick_bytes": [TICK.itemsize], "rate": RATES, "capture": [False, True]}
    if not isinstance(about, dict) or any(about.get(name) not in values for name, values in known.items()):
        raise InputError(f"{folder / ABOUT}: damaged, or written by another version of the runtime")
    data = read_file(folder / TICKS, "ticks of a log")
    ticks = np.frombuffer(data[: len(data) - len(data) % TICK.itemsize], TICK)
    if not len(ticks) or not np.isin(ticks["request"], [*Request]).all():
        raise InputError(f"{folder / TICKS}: no ticks, or damaged")
    return ticks, about


def replay(folder: Path, bundle: Bundle) -> tuple[int, int]:
    """Run the runtime on the frames and requests of a log; return its ticks, and the first that differs, or -1.

    A log of a robot in PASSIVE from its first tick on replays bit for bit.
    """
    ticks, about = read_log(folder)
    source = MotionCapture() if about["capture"] else None
    received = iter(ticks["received"])
    link: Any = SimpleNamespace(send=lambda frames: None, collect=lambda: next(received))
    runtime = Runtime(bundle, link, source, rate=about["rate"], dry_run=bool(about.get("dry_run")))
    for number, logged in enumerate(ticks):
        ours = runtime.tick(Request(int(logged["request"])), logged["values"], float(logged["late"]))
        if ours.tobytes() != logged.tobytes():
            return len(ticks), number
    return len(ticks), -1
