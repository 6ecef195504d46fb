"""Watchdog: a process of its own that brakes the robot and switches its motors off when the runtime stops or dies.

The runtime writes a byte to a pipe each tick. When the pipe closes or is silent for too long, the watchdog sends
damping commands for some time and then exit frames, over sockets of its own. MIT mode has no watchdog of its own that
the runtime could count on.
"""

from __future__ import annotations

import multiprocessing
import os
import select
import time
from collections.abc import Callable
from contextlib import suppress
from typing import Any

import numpy as np

from jumper_warp.deploy.bundle import JointMap
from jumper_warp.deploy.bus import Link, open_buses
from jumper_warp.deploy.codec import EXIT
from jumper_warp.utils.errors import InputError

SILENCE = 0.02  # [s] without a tick after which the watchdog acts
DAMPING_TIME = 2.0  # [s]
PERIOD = 0.002  # [s] between damping commands


def watch(pipe: int, other: int, spec: str, settings: dict[str, Any], silence: float, damping_time: float) -> None:
    """Wait until the pipe (a file descriptor) closes or is silent, then brake and switch the motors off.

    The first byte begins the watch, since the runtime needs time to start. A byte `q` ends it without that.

    other: the end of the pipe that the runtime writes to. spec: of the buses, see `open_buses`. settings: of
    deploy.yaml.
    """
    os.close(other)
    os.setsid()  # signals of the terminal do not reach it
    link = Link(open_buses(spec, "watchdog"))
    timeout = None
    while select.select([pipe], [], [], timeout)[0]:
        timeout = silence
        data = os.read(pipe, 4096)
        if b"q" in data:
            os._exit(0)  # without destructors of the runtime's buses
        if not data:
            break
    brake(link, settings, damping_time)
    os._exit(0)


def brake(link: Link, settings: dict[str, Any], seconds: float, sleep: Callable[[float], Any] = time.sleep) -> None:
    """Send damping commands for some seconds, then exit frames."""
    damping = np.array(settings["safety"]["damping"])
    frames = JointMap(settings).frames(np.zeros(12), np.zeros(12), damping)
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        link.send(frames)
        sleep(PERIOD)
    for _ in range(3):
        link.send(np.tile(np.frombuffer(EXIT, np.uint8), (12, 1)))
        sleep(PERIOD)


class Watchdog:
    """Watchdog process of a runtime; call `beat` every tick."""

    def __init__(
        self, spec: str, settings: dict[str, Any], silence: float = SILENCE, damping_time: float = DAMPING_TIME
    ) -> None:
        """Start the process; arguments: as in `watch`."""
        reader, self._writer = os.pipe()
        arguments = (reader, self._writer, spec, settings, silence, damping_time)
        self.process = multiprocessing.get_context("fork").Process(target=watch, args=arguments, daemon=False)
        os.set_blocking(self._writer, False)
        self.process.start()
        os.close(reader)

    def beat(self) -> None:
        """Report that the runtime has done a tick. Raises InputError: the watchdog has switched the motors off."""
        try:
            with suppress(BlockingIOError):
                os.write(self._writer, b".")
        except BrokenPipeError:
            raise InputError("the watchdog has switched the motors off: no tick for too long") from None

    def close(self) -> None:
        """End the watch of a runtime that has switched its motors off."""
        with suppress(BrokenPipeError):
            os.write(self._writer, b"q")
        os.close(self._writer)
        self.process.join()
