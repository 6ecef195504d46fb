"""Measure `jumper drive`: time from a key to motion, CPU time, and data sent to a visitor.

    python experiments/drive_latency.py --presses 40

A client on the loopback address takes the place of the browser: it sends the message of a pressed key, and waits for
poses in which the base has moved. A browser adds the time of its own event handling and of one drawn frame.
"""

from __future__ import annotations

import asyncio
import os
import re
import subprocess
import sys
import time
from dataclasses import dataclass, field
from typing import Any

import msgspec
import numpy as np
import websockets
import zstandard

from jumper_warp.live.page import KEY_LABEL
from jumper_warp.utils.output import output_dir
from support.scripts import OutputArgs, report, run_script

MOVED = 1.0e-4  # [m] Displacement of the base that counts as motion
REST = 2.0  # [s] Time between two presses
CAMERA = {
    "type": "ViewerCameraMessage", "wxyz": [1, 0, 0, 0], "position": [1, 1, 1], "fov": 1.0, "near": 0.1, "far": 100.0,
    "image_height": 600, "image_width": 800, "look_at": [0, 0, 0], "up_direction": [0, 0, 1],
}  # fmt: skip
"""Message with which a page introduces itself."""


@dataclass(frozen=True)
class Args(OutputArgs):
    """Measure `jumper drive`: latency from key to motion, CPU time, and bytes per second to one visitor."""

    presses: int = 40  # Number of pressed keys


@dataclass
class Visitor:
    """Visitor whose page draws nothing; attributes are what it has received."""

    socket: Any
    received: int = 0  # [bytes]
    steps: int = 0  # Poses of the robot
    keys: str = ""  # Identifier of the text field that takes the keys
    position: np.ndarray = field(default_factory=lambda: np.zeros(2))  # [m] x, y of the base

    async def listen(self) -> None:
        """Receive messages until the connection ends."""
        decompress = zstandard.ZstdDecompressor().decompress
        async for data in self.socket:
            self.received += len(data)
            size, packed = (int.from_bytes(data[i : i + 8], "little") for i in (0, 8))
            content = msgspec.msgpack.decode(decompress(data[16 : 16 + packed], max_output_size=size))
            for message in content["messages"]:
                if message["type"] == "GuiTextMessage" and message["props"]["label"] == KEY_LABEL:
                    self.keys = message["uuid"]
                if message["type"] == "SetPositionMessage" and message["name"] == "/world":
                    self.position = -np.array(message["position"][:2])
                    self.steps += 1

    async def press(self, keys: str) -> None:
        """Send the keys that are held."""
        message = {"type": "GuiUpdateMessage", "uuid": self.keys, "updates": {"value": keys}}
        await self.socket.send(msgspec.msgpack.encode(message))

    async def latency(self) -> float:
        """Return the time from a pressed key to motion [s], then release the key."""
        start = self.position
        begin = time.perf_counter()
        await self.press("i")
        while np.linalg.norm(self.position - start) < MOVED:
            await asyncio.sleep(0.001)
        seconds = time.perf_counter() - begin
        await self.press("")
        return seconds


def cpu_seconds(process: int) -> float:
    """Return the CPU time [s] of a process so far; process: its number."""
    with open(f"/proc/{process}/stat") as file:
        user, system = file.read().rpartition(")")[2].split()[11:13]
    return (int(user) + int(system)) / os.sysconf("SC_CLK_TCK")


async def measure(port: str, process: int, presses: int) -> dict[str, float]:
    """Return latencies, CPU share, rate of poses and of data of a served page, by name."""
    origin: Any = f"http://localhost:{port}"
    address = f"ws://127.0.0.1:{port}"
    async with websockets.connect(address, origin=origin, subprotocols=["viser-v1.1.1"], max_size=None) as socket:  # pyright: ignore
        visitor = Visitor(socket)
        listening = asyncio.create_task(visitor.listen())
        await socket.send(msgspec.msgpack.encode(CAMERA))
        await asyncio.sleep(10.0)
        before = (cpu_seconds(process), visitor.received, visitor.steps, time.perf_counter())
        times = []
        for _ in range(presses):
            times.append(await visitor.latency())
            await asyncio.sleep(REST)
        now = (cpu_seconds(process), visitor.received, visitor.steps, time.perf_counter())
        cpu, data, steps, seconds = (b - a for a, b in zip(before, now, strict=True))
        listening.cancel()
    return {
        "key_to_motion_median_ms": 1.0e3 * float(np.median(times)),
        "key_to_motion_p95_ms": 1.0e3 * float(np.percentile(times, 95)),
        "cpu_share": cpu / seconds,
        "poses_per_second": steps / seconds,
        "kilobytes_per_second": 1.0e-3 * data / seconds,
        "load_of_machine": os.getloadavg()[0],
    }


def main(args: Args) -> None:
    """Start `jumper drive`, measure it, and end it."""
    command = [sys.executable, "-m", "jumper_warp", "drive", "--device", "cpu", "--port", "8300"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as server:
        assert server.stdout is not None
        found = None
        while not found:
            found = re.search(r"http://localhost:(\d+)", server.stdout.readline())
        metrics = asyncio.run(measure(found[1], server.pid, args.presses))
        server.terminate()
    report(args, output_dir("drive_latency", args.out), metrics, f"{args.presses} presses of a key", metrics)


if __name__ == "__main__":
    run_script(main, Args)
