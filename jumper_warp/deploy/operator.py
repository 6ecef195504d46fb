"""Requests of the operator: from the keyboard of a terminal, or from a gamepad of Linux."""

from __future__ import annotations

import os
import select
import struct
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from typing import Any, ClassVar

from jumper_warp.deploy.policy import JOINTS
from jumper_warp.deploy.runtime import Request

HELP = """\
space stop   p motors off   e enable   c confirm (stand up; in Hold: sign test)   h hold
n next joint (in Hold, on a stand: move it)   z make its present angle zero (motors off)
w s a d q r  walk: faster ahead, back, left, right, turn left, turn right   x stand still
j jump up    g jump to the place ahead"""
STEP = 0.1  # [m/s], [rad/s] of a key
JOYSTICK = struct.Struct("IhBB")  # time, value, type, number: an event of /dev/input/js0
BUTTONS = {0: "JUMP_UP", 1: "STOP", 2: "JUMP_TO", 3: "WALK", 6: "STAND", 7: "CONFIRM"}  # requests
AXES = {1: (0, -1.0), 0: (1, -0.5), 3: (2, -1.0)}  # component of the velocity and its value at full deflection

Command = tuple[Request, tuple[float, ...]]  # with up to three values
NOTHING: Command = (Request.NONE, ())


class Keyboard:
    """Requests from keys, and from a gamepad if there is one; `poll` never waits."""

    KEYS: ClassVar = {" ": "STOP", "p": "PASSIVE", "e": "STAND", "c": "CONFIRM", "h": "HOLD"}  # requests
    MOVES: ClassVar = {"w": (0, 1), "s": (0, -1), "a": (1, 1), "d": (1, -1), "q": (2, 1), "r": (2, -1)}

    def __init__(self, height: float, place: Sequence[float], gamepad: str = "/dev/input/js0") -> None:
        """Take the height of jumps up [m], the place of others, ahead and left [m], and the gamepad's device."""
        self._jumps = {"j": (Request.JUMP_UP, (height, 0.0, 0.0)), "g": (Request.JUMP_TO, (*place, 0.0))}
        self._velocity = [0.0, 0.0, 0.0]
        self._joint = -1
        self._pad = None
        with suppress(OSError):
            self._pad = os.open(gamepad, os.O_RDONLY | os.O_NONBLOCK)

    def poll(self) -> Command:
        """Return the request since the last call."""
        if select.select([sys.stdin], [], [], 0.0)[0] and (key := os.read(sys.stdin.fileno(), 1)):  # b"": at its end
            return self.key(key.decode(errors="replace"))
        if self._pad is not None:
            with suppress(BlockingIOError):
                return self.event(*JOYSTICK.unpack(os.read(self._pad, JOYSTICK.size))[1:])
        return NOTHING

    def key(self, key: str) -> Command:
        """Return the request of a key."""
        if key in self._jumps:
            return self._jumps[key]
        if key in ("n", "z"):
            self._joint += key == "n"
            joint = self._joint % 12
            print(JOINTS[joint], flush=True)
            return Request.JOINT if key == "n" else Request.ZERO, (float(joint), 0.0, 0.0)
        if key in self.MOVES:
            axis, sign = self.MOVES[key]
            self._velocity[axis] += sign * STEP
        elif key == "x":
            self._velocity = [0.0, 0.0, 0.0]
        else:
            return Request[self.KEYS.get(key, "NONE")], ()
        return Request.WALK, tuple(self._velocity)

    def event(self, value: int, kind: int, number: int) -> Command:
        """Return the request of a gamepad's event: kind 1 a button, 2 an axis."""
        if kind == 2 and number in AXES:
            axis, full = AXES[number]
            self._velocity[axis] = full * value / 32767
            return Request.WALK, tuple(self._velocity)
        if kind == 1 and value and number in BUTTONS:
            request = Request[BUTTONS[number]]
            key = {Request.JUMP_UP: "j", Request.JUMP_TO: "g"}.get(request)
            return self._jumps[key] if key else (request, tuple(self._velocity))
        return NOTHING


@contextmanager
def raw_terminal() -> Iterator[None]:
    """Let the terminal pass keys at once, without echo, and restore it."""
    import termios
    import tty

    if not sys.stdin.isatty():
        yield
        return
    saved: Any = termios.tcgetattr(sys.stdin)
    try:
        tty.setcbreak(sys.stdin)
        yield
    finally:
        termios.tcsetattr(sys.stdin, termios.TCSADRAIN, saved)
