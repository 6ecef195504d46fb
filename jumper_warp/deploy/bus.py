"""CAN buses of the robot: Unix datagrams as a bus of python-can, and the exchange of all frames of a tick.

A leg has a bus (FL, FR, BL, BR) with three motors, ids 1 to 3: motor 3 · leg + j has the id j + 1. IMU and motion
capture are on the first bus.
"""

from __future__ import annotations

import select
import socket
import struct
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import can
import numpy as np

from jumper_warp.deploy.sensors import SENSOR_IDS
from jumper_warp.utils.errors import InputError

LEGS, MOTORS = 4, 3  # buses, and motors of each
SYNC = 0x7FE  # Id of the frame that ends a side's frames of a tick in lockstep
RECEIVED = np.dtype([
    ("motor", "u1", (12, 8)), ("motor_fresh", "?", 12), ("sensor", "u1", (len(SENSOR_IDS), 8)),
    ("sensor_fresh", "?", len(SENSOR_IDS)), ("error_frames", "u1"), ("unknown", "u1"), ("bus_off", "?", LEGS),
])  # fmt: skip
"""Frames received in a tick: newest data and whether they are new, number of error frames and of unknown frames, and
buses that cannot send."""
LOCKSTEP_TIMEOUT = 30.0  # [s] Longest wait for the other side in lockstep
_FRAME = struct.Struct("<dIBB8s")  # time of sending, id, length, whether it is an error frame, data


def data_frame(number: int, data: bytes, bus: int | None = None) -> can.Message:
    """Return a data frame with an arbitration id; bus: number of its bus."""
    return can.Message(arbitration_id=number, data=data, is_extended_id=False, channel=bus)


class UnixBus(can.BusABC):
    """Bus over Unix datagrams between two sockets of this machine."""

    def __init__(self, local: Path | None, peer: Path) -> None:
        """Bind a socket to the path `local` (None: only send), and send to the path `peer`.

        Raises CanInitializationError: another process has bound `local`. A socket of a dead process is replaced.
        """
        super().__init__(channel=str(peer))
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self._peer, self._local = str(peer), None
        if local is not None:
            with suppress(FileNotFoundError, ConnectionRefusedError):
                self._socket.connect(str(local))
                self.shutdown()
                raise can.CanInitializationError(f"another process uses {local}")
            local.unlink(missing_ok=True)
            self._socket.bind(str(local))
            self._local = local
        self._socket.setblocking(False)
        self.fileno = self._socket.fileno

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        """Send a frame at once. Raises CanOperationError: the queue is full, or nobody has bound the peer."""
        try:
            frame = _FRAME.pack(time.time(), msg.arbitration_id, msg.dlc, msg.is_error_frame, msg.data)
            self._socket.sendto(frame, self._peer)
        except OSError as error:
            raise can.CanOperationError(f"{self._peer}: {error}") from error

    def recv(self, timeout: float | None = None) -> can.Message | None:
        """Return the next frame, or None after `timeout` [s]."""
        if timeout != 0.0 and not select.select([self._socket], [], [], timeout)[0]:
            return None
        try:
            sent, number, length, error, data = _FRAME.unpack(self._socket.recv(_FRAME.size))
        except BlockingIOError:
            return None
        return can.Message(sent, number, is_extended_id=False, is_error_frame=bool(error), data=data[:length])

    def shutdown(self) -> None:
        """Close the socket and remove its path."""
        super().shutdown()
        self._socket.close()
        if self._local is not None:
            self._local.unlink(missing_ok=True)


def open_buses(spec: str, side: str = "host") -> list[can.BusABC]:
    """Return the four buses of a specification: socketcan:can0,can1,can2,can3, udp_multicast:PORT, or unix:FOLDER.

    side: "host" (the runtime), "robot" (the simulated far end) or "watchdog" (only sends). The last two reach this
    machine alone: UDP packets have a hop limit of 0, and the folder is created for its owner only.
    Raises InputError: the specification is wrong, this machine lacks the interface, or another process has this side
    of the folder.
    """
    kind, _, channel = spec.partition(":")
    try:
        if kind == "socketcan" and channel.count(",") == LEGS - 1:
            return [can.Bus(interface="socketcan", channel=name) for name in channel.split(",")]
        if kind == "udp_multicast":
            ports = range(int(channel), int(channel) + LEGS)  # one port a bus: groups cross-talk
            return [can.Bus(interface="udp_multicast", channel="239.74.163.2", port=p, hop_limit=0) for p in ports]
        if kind == "unix" and channel:
            Path(channel).mkdir(mode=0o700, parents=True, exist_ok=True)
            far = "robot" if side != "robot" else "host"
            own = {i: Path(channel, f"{side}{i}") for i in range(LEGS) if side != "watchdog"}
            return [UnixBus(own.get(i), Path(channel, f"{far}{i}")) for i in range(LEGS)]
    except (can.CanError, OSError, ImportError, ValueError) as error:
        raise InputError(f"{spec}: {error}") from error
    raise InputError(f"bus must be socketcan:can0,can1,can2,can3, udp_multicast:PORT or unix:FOLDER, got {spec!r:.60}")


class Link:
    """Exchange of a tick's frames over four buses: send all, then collect until a deadline, and wait for no motor."""

    def __init__(
        self, buses: Sequence[can.BusABC], *, reply_id: int | None = 0, deadline: float = 1.0e-3,
        pump: Callable[[], Any] | None = None, listener: Callable[[can.Message], Any] | None = None,
    ) -> None:  # fmt: skip
        """Prepare the exchange.

        reply_id: arbitration id of the motors' replies; None: the motor's own id. deadline: longest wait [s] for
        replies. pump: called in lockstep after sending, which may advance a far end of this process; the link then
        waits for the far end's SYNC frames. listener: called with every frame, such as a logger of python-can.
        """
        self.buses = list(buses)
        self.received = np.zeros((), RECEIVED)
        self._data = {name: self.received[name].data.cast("B") for name in ("motor", "sensor")}
        self.listener = listener
        self._reply_id, self._deadline, self._pump = reply_id, deadline, pump
        self._begin, self._end = 0.0, 0.0  # of the exchange, and of the wait for replies
        self._sent = b""

    def send(self, frames: np.ndarray) -> None:
        """Send the motors' frames (12, 8) uint8, of each bus in turn; a bus that cannot send is marked as off."""
        record = self.received
        data = self._sent = frames.tobytes()
        for name in ("motor_fresh", "sensor_fresh", "error_frames", "unknown", "bus_off"):
            record[name] = 0
        self._begin = time.time()
        rows = [(leg, j) for j in range(MOTORS) for leg in range(LEGS)]
        queue = [(leg, j + 1, data[8 * (MOTORS * leg + j) :][:8]) for leg, j in rows]
        if self._pump is not None:
            queue += [(leg, SYNC, b"") for leg in range(LEGS)]
        for leg, number, part in queue:
            message = data_frame(number, part, leg)
            if self.listener is not None and number != SYNC:
                message.timestamp = time.time()
                self.listener(message)
            try:
                self.buses[leg].send(message)
            except can.CanError:
                record["bus_off"][leg] = True
        self._end = time.monotonic() + self._deadline

    def collect(self) -> np.ndarray:
        """Return the frames received in this tick, a record of RECEIVED; waits until all came or the deadline.

        Data of frames that did not come are the last ones received. Raises InputError: no far end in lockstep.
        """
        record = self.received
        if self._pump is not None:
            self._pump()
            for leg, bus in enumerate(self.buses):
                while (message := bus.recv(LOCKSTEP_TIMEOUT)) is not None and message.arbitration_id != SYNC:
                    self._take(leg, message)
                if message is None:
                    self._pump = None  # the last ticks, which brake, do not wait
                    raise InputError(f"no frames in lockstep for {LOCKSTEP_TIMEOUT:g} s: run jumper bus-sim --lockstep")
            return record.copy()
        time.sleep(0.3 * self._deadline)  # no reply comes before: each wake-up takes CPU time
        waiting = {bus.fileno(): leg for leg, bus in enumerate(self.buses)}
        while not (record["motor_fresh"].all() and record["sensor_fresh"][:2].all()):
            left = self._end - time.monotonic()
            ready = select.select(list(waiting), [], [], max(0.0, left))[0]
            for leg in map(waiting.__getitem__, ready):
                with suppress(can.CanError):
                    if (message := self.buses[leg].recv(0.0)) is not None:
                        self._take(leg, message)
            if not ready and left <= 0.0:
                break
        return record.copy()

    def _take(self, leg: int, message: can.Message) -> None:
        """Store a received frame; frames of other ids are counted as unknown, and own ones, of multicast, ignored."""
        record, data, number = self.received, message.data, message.arbitration_id
        motor = data[0] if len(data) == 8 else 0
        if 1 <= number <= MOTORS and data == self._sent[8 * (MOTORS * leg + number - 1) :][:8]:
            return
        if self.listener is not None:
            message.channel = leg
            self.listener(message)
        if message.is_error_frame:
            record["error_frames"] = min(255, int(record["error_frames"]) + 1)
        elif leg == 0 and number in SENSOR_IDS and len(data) == 8:
            row = SENSOR_IDS.index(number)
            self._data["sensor"][8 * row : 8 * row + 8] = data
            record["sensor_fresh"][row] = True
        elif 1 <= motor <= MOTORS and number == (motor if self._reply_id is None else self._reply_id):
            row = MOTORS * leg + motor - 1
            self._data["motor"][8 * row : 8 * row + 8] = data
            record["motor_fresh"][row] |= not 0.0 < message.timestamp < self._begin  # late replies: of the last tick
        else:
            record["unknown"] = min(255, int(record["unknown"]) + 1)

    def close(self) -> None:
        """Close all buses."""
        for bus in self.buses:
            bus.shutdown()
