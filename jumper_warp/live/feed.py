"""Process that shows a training, and the bounded queue that feeds it; a slow or killed viewer delays nothing."""

from __future__ import annotations

import io
import json
import os
import subprocess
import sys
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from threading import Event, Thread
from typing import Any, BinaryIO, Literal, NamedTuple

import numpy as np

from jumper_warp.live.clips import Layout
from jumper_warp.live.scene import RobotScene
from jumper_warp.utils.errors import InputError
from jumper_warp.utils.files import Json, write_atomically
from jumper_warp.viz.rerun_server import is_served
from jumper_warp.viz.shapes import packed_shapes, unpacked_shapes

ADDRESS = "watch.txt"  # File in a run's folder with the address of its live view
QUEUED = 8  # Largest number of iterations that wait for the viewer; older ones are dropped
Viewer = Literal["rerun", "viser", "none"]
PACKAGES = Path(__file__).parents[2]  # Folder that Python searches for this package


def packed(header: Json, **arrays: np.ndarray) -> bytes:
    """Return a message as bytes: its length, then a NumPy archive of a JSON header and arrays, without pickles."""
    data = io.BytesIO()
    everything: dict[str, Any] = {"header": np.array(json.dumps(header)), **arrays}
    np.savez(data, **everything)
    return len(data.getvalue()).to_bytes(8, "little") + data.getvalue()


def unpacked(source: BinaryIO) -> tuple[Json, dict[str, np.ndarray]]:
    """Return header and arrays of the next message in a stream. Raises EOFError: the stream ends."""
    size = int.from_bytes(source.read(8), "little")
    data = source.read(size)
    if not size or len(data) < size:
        raise EOFError
    with np.load(io.BytesIO(data), allow_pickle=False) as archive:
        arrays = {name: archive[name] for name in archive.files}
    return json.loads(str(arrays.pop("header"))), arrays


class Steps(NamedTuple):
    """Policy steps of an iteration of one run."""

    run: int  # index in `Setup.folders`
    number: int  # counts the iterations of this process
    iteration: int  # of the training
    words: np.ndarray  # (steps, slots, columns) int32, see `WorldBuffer`

    def message(self) -> bytes:
        """Return the message for `read`."""
        return packed({"run": self.run, "number": self.number, "iteration": self.iteration}, words=self.words)

    @classmethod
    def read(cls, source: BinaryIO) -> Steps:
        """Return the steps of the next message in a stream. Raises EOFError: the stream ends."""
        header, arrays = unpacked(source)
        return cls(**header, words=arrays["words"])


@dataclass(frozen=True)
class Setup:
    """Everything that the viewer's process needs to know before the first policy step."""

    folders: tuple[Path, ...]  # of the runs, one for each seed; their metrics files are read
    titles: tuple[str, ...]  # of the runs
    scene: RobotScene
    layout: Layout
    terms: tuple[str, ...]  # names of the reward terms
    endings: tuple[str, ...]  # names of the terminations
    state: np.dtype  # of the task's state
    goal: str  # field of the state that is marked in the scene; empty: none
    step_dt: float  # [s] policy step
    elapsed: float  # [s] training time so far
    viewer: Viewer = "rerun"
    video_every: int = 0  # iterations between two films; 0: none
    wandb: str | None = None  # project of Weights & Biases for the films

    def __post_init__(self) -> None:
        """Raise InputError: viser is asked for and not installed."""
        if self.viewer == "viser" and find_spec("viser") is None:
            raise InputError('--viewer viser needs viser: pip install "jumper-warp[drive]"')

    def message(self) -> bytes:
        """Return the message for `read`."""
        scene = self.scene
        shapes, arrays = packed_shapes(scene.shapes)
        header = {name: value for name, value in vars(self).items() if name not in ("folders", "scene", "state")}
        header |= {"folders": [str(folder) for folder in self.folders]}
        header |= {"shapes": shapes, "links": scene.links, "shank": scene.shank}
        return packed(header, anchors=scene.anchors, axes=scene.axes, state=np.zeros(0, self.state), **arrays)

    @classmethod
    def read(cls, source: BinaryIO) -> Setup:
        """Return the setup of the next message in a stream. Raises EOFError: the stream ends."""
        header, arrays = unpacked(source)
        shapes, links, shank = (header.pop(name) for name in ("shapes", "links", "shank"))
        scene = RobotScene(unpacked_shapes(shapes, arrays), links, arrays["anchors"], arrays["axes"], shank)
        fields: Json = {name: tuple(value) if isinstance(value, list) else value for name, value in header.items()}
        fields["folders"] = tuple(map(Path, header["folders"]))
        fields["layout"] = {name: tuple(columns) for name, columns in header["layout"].items()}
        return cls(scene=scene, state=arrays["state"].dtype, **fields)


def start_module(module: str, *arguments: str, stdin: int = subprocess.DEVNULL) -> subprocess.Popen:
    """Start a module of this package in a process of its own, which does not receive this terminal's Ctrl-C.

    stdin: of the process, as in `subprocess.Popen`.
    """
    path = os.pathsep.join(filter(None, (str(PACKAGES), os.environ.get("PYTHONPATH"))))
    return subprocess.Popen(
        [sys.executable, "-P", "-m", module, *arguments], stdin=stdin, bufsize=0, start_new_session=True,
        env={**os.environ, "PYTHONPATH": path},
    )  # fmt: skip


def write_address(folders: Sequence[Path], url: str, page: str) -> None:
    """Write the addresses of a live view to the runs' folders, where `jumper watch` finds them."""
    for folder in folders:
        write_atomically(folder / ADDRESS, f"{url}\n{page}\n".encode())


def live_address(run: Path) -> tuple[str, str] | None:
    """Return the addresses that `write_address` wrote last into a run's folder, or one within, if a server answers."""
    files = [file for pattern in (ADDRESS, f"*/{ADDRESS}", f"*/*/{ADDRESS}") for file in run.glob(pattern)]
    for file in sorted(files, key=lambda file: file.stat().st_mtime, reverse=True):
        lines = file.read_text(errors="replace").splitlines()
        if len(lines) == 2 and is_served(lines[0]):
            return lines[0], lines[1]
    return None


class Feed:
    """Feed of the viewer's process."""

    def __init__(self, setup: Setup) -> None:
        """Start the process; setup: first message, never dropped."""
        self.process = start_module("jumper_warp.live.viewer", stdin=subprocess.PIPE)
        self._queue: deque[Setup | Steps] = deque(maxlen=QUEUED)
        self._ready = Event()
        self._ending = False
        self.broken = False  # Whether the process has ended
        self._thread = Thread(target=self._send, args=(setup,), daemon=True)
        self._thread.start()

    def put(self, message: Steps) -> None:
        """Enqueue a message without waiting; it replaces the oldest one of a full queue."""
        self._queue.append(message)
        self._ready.set()

    def close(self, seconds: float = 1.0) -> None:
        """Close the process's input after the enqueued messages, and wait for that, at most some time [s]."""
        self._ending = True
        self._ready.set()
        self._thread.join(seconds)

    def _send(self, message: Setup | Steps) -> None:
        """Write messages to the process, in a thread of its own, until `close` or the end of the process."""
        pipe = self.process.stdin
        assert pipe is not None
        try:
            while True:
                data = memoryview(message.message())
                while data:
                    data = data[pipe.write(data) :]
                while not self._queue:
                    if self._ending:
                        return
                    self._ready.wait()
                    self._ready.clear()
                message = self._queue.popleft()
        except OSError:
            self.broken = True
        finally:
            pipe.close()
