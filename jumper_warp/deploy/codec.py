"""MIT-mode CAN frames of the CubeMars motors: commands, replies, special frames, and their DBC description.

A command holds position (16 bits), velocity, kp, kd and torque (12 bits each); a reply the motor's id, position,
velocity, torque, temperature and error code. A physical value is code · factor + lower. Codes are big-endian.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

ENTER, EXIT, ZERO = (bytes([0xFF] * 7 + [last]) for last in (0xFC, 0xFD, 0xFE))
"""Frames that switch a motor to MIT mode, switch it off, and make its present position zero."""
COMMAND_BITS = (16, 12, 12, 12, 12)  # position, velocity, kp, kd, torque
HOST_ID = 0  # Arbitration id of replies, whose first byte is the motor's id
KINDS = {"AK80-9": 18.0, "AK70-10": 25.0}  # Full scale of the torque by type of motor [N m]


class Reply(NamedTuple):
    """Decoded replies of n motors."""

    position: np.ndarray  # (n,) [rad]
    velocity: np.ndarray  # (n,) [rad/s]
    torque: np.ndarray  # (n,) [N m]
    temperature: np.ndarray  # (n,) [°C]
    error: np.ndarray  # (n,) error code: 0 none, 1 temperature, 2 current, 3 and 4 voltage, 5 encoder, 6 phases


class Fields:
    """Fields of frames of 8 bytes, the most significant first."""

    def __init__(self, bits: Sequence[int]) -> None:
        """Take the number of bits of each field; their sum is 64."""
        self._shift = (64 - np.cumsum(bits))[:, None]
        self._mask = 2 ** np.array(bits)[:, None] - 1

    def pack(self, codes: np.ndarray) -> np.ndarray:
        """Return frames (n, 8) uint8 with codes (fields, n) int64."""
        return np.bitwise_or.reduce(codes << self._shift).astype(">i8").view(np.uint8).reshape(-1, 8)

    def unpack(self, frames: np.ndarray) -> np.ndarray:
        """Return the codes (fields, n) int64 of frames (n, 8) uint8."""
        return np.ascontiguousarray(frames).view(">i8")[:, 0] >> self._shift & self._mask


COMMAND = Fields(COMMAND_BITS)
REPLY = Fields((8, 16, 12, 12, 8, 8))  # id of the motor, position, velocity, torque, temperature, error code


class Codec:
    """Encoder and decoder of the frames of several motors."""

    def __init__(self, kinds: Sequence[str]) -> None:
        """Prepare the scales of motors of the given types, keys of KINDS."""
        torque = np.array([KINDS[kind] for kind in kinds])
        upper = [np.full(len(torque), value) for value in (12.5, 50.0, 500.0, 5.0)] + [torque]
        lower = [-upper[0], -upper[1], 0.0 * upper[2], 0.0 * upper[3], -torque]
        codes = 2 ** np.array(COMMAND_BITS)[:, None] - 1
        self.lower = np.array(lower)  # (5, n) [rad], [rad/s], [N m/rad], [N m s/rad], [N m]
        self.upper = np.array(upper)
        self.factor = (self.upper - self.lower) / codes
        self.largest = np.broadcast_to(codes, self.lower.shape).copy()
        self._reply_factor, self._reply_lower = self.factor[[0, 1, 4]], self.lower[[0, 1, 4]]
        self.largest[2] -= 1  # kp below its full scale: no command equals ENTER, EXIT or ZERO

    def codes(self, commands: np.ndarray) -> np.ndarray:
        """Return the codes of commands (5, n), saturated. Raises ValueError: one is NaN."""
        if np.isnan(commands).any():
            raise ValueError("a motor command is NaN")
        within = np.minimum(np.maximum(commands, self.lower), self.upper)
        return np.minimum(np.rint((within - self.lower) / self.factor).astype(np.int64), self.largest)

    def encode(self, commands: np.ndarray) -> np.ndarray:
        """Return the data of command frames, (n, 8) uint8; commands: rows position, velocity, kp, kd, torque, (5, n).

        Values beyond their range saturate. Raises ValueError: one is NaN.
        """
        return COMMAND.pack(self.codes(commands))

    def decode_command(self, data: np.ndarray) -> np.ndarray:
        """Return the commands (5, n) in command frames (n, 8)."""
        return COMMAND.unpack(data) * self.factor + self.lower

    def encode_reply(self, ids: np.ndarray, reply: Reply) -> np.ndarray:
        """Return the data of reply frames, (n, 8) uint8; ids: (n,) ids of the motors on their buses."""
        zero = np.zeros_like(reply.position)
        rows = [reply.position, reply.velocity, zero, zero, reply.torque]
        position, velocity, _, _, torque = self.codes(np.array(rows))
        temperature = np.clip(np.rint(reply.temperature), 0, 255).astype(np.int64)
        return REPLY.pack(np.array([ids, position, velocity, torque, temperature, reply.error]))

    def decode_reply(self, data: np.ndarray) -> Reply:
        """Return the values in reply frames (n, 8)."""
        codes = REPLY.unpack(data)
        position, velocity, torque = codes[1:4] * self._reply_factor + self._reply_lower
        return Reply(position, velocity, torque, codes[4].astype(float), codes[5])


def dbc(kinds: Sequence[str]) -> str:
    """Return a DBC file of one bus whose motors have ids 1, 2, … and the given types.

    Commands are messages with the motor's id; all replies have the id HOST_ID, with the torque's scale by motor.
    """
    codec = Codec(kinds)

    def signal(name: str, start: int, bits: int, row: int, motor: int, unit: str, receiver: str) -> str:
        """Return a line of a signal; start: its most significant bit."""
        factor, lower, upper = (float(each[row, motor]) for each in (codec.factor, codec.lower, codec.upper))
        return f' SG_ {name} : {start}|{bits}@0+ ({factor!r},{lower!r}) [{lower!r}|{upper!r}] "{unit}" {receiver}'

    lines = ['VERSION ""', "", "NS_ :", "", "BS_:", "", "BU_: host motor", ""]
    rows = (
        ("position", 7, "rad"), ("velocity", 23, "rad/s"), ("kp", 27, "Nm/rad"), ("kd", 47, "Nms/rad"),
        ("torque", 51, "Nm"),
    )  # fmt: skip
    for motor in range(len(kinds)):
        lines.append(f"BO_ {motor + 1} command_{motor + 1}: 8 host")
        for row, (name, start, unit) in enumerate(rows):
            lines.append(signal(name, start, COMMAND_BITS[row], row, motor, unit, "motor"))
        lines.append("")
    lines += [f"BO_ {HOST_ID} reply: 8 motor", ' SG_ motor M : 7|8@0+ (1,0) [0|255] "" host']
    lines += [signal("position", 15, 16, 0, 0, "rad", "host"), signal("velocity", 31, 12, 1, 0, "rad/s", "host")]
    for motor in range(len(kinds)):
        lines.append(signal(f"torque_{motor + 1} m{motor + 1}", 35, 12, 4, motor, "Nm", "host"))
    for name, start in (("temperature", 55), ("error", 63)):
        lines.append(f' SG_ {name} : {start}|8@0+ (1,0) [0|255] "" host')
    return "\n".join([*lines, ""])
