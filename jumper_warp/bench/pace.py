"""Simulated far end in real time: frames take their wire time, and the physics keeps up with the clock."""

from __future__ import annotations

import heapq
import itertools
import select
import time
from contextlib import suppress

import can

from jumper_warp.bench.bus_sim import BusSim
from jumper_warp.deploy.realtime import request_real_time

WIRE_TIME = 1.2e-4  # [s] of a frame of 8 bytes at 1 Mbit/s


def serve_in_real_time(far: BusSim, seconds: float, latency: float) -> None:
    """Answer commands as they arrive, and advance the simulation by a tick each far.dt [s].

    A frame occupies its bus for WIRE_TIME. latency: of a motor's reply [s].
    """
    request_real_time()
    pending: list[tuple[float, int, int, can.Message]] = []  # time, order, bus, frame
    order = itertools.count()
    free = [0.0] * len(far.buses)  # time from which each bus is free
    descriptors = {bus.fileno(): number for number, bus in enumerate(far.buses)}
    start = due = time.monotonic()

    def occupy(number: int, now: float) -> float:
        """Return when a frame that is ready at `now` has passed a bus."""
        free[number] = max(free[number], now) + WIRE_TIME
        return free[number]

    while due - start < seconds:
        now = time.monotonic()
        while pending and pending[0][0] <= now:
            _, _, number, message = heapq.heappop(pending)
            with suppress(can.CanError):  # nobody listens
                far.send(far.buses[number], message)
        if now >= due:
            far.advance()
            for message in far.sensors():
                heapq.heappush(pending, (occupy(0, now), next(order), 0, message))
            due = max(due + far.dt, now - 0.1)  # do not catch up after a pause
        wake = min(due, pending[0][0] if pending else due)
        for descriptor in select.select(list(descriptors), [], [], max(0.0, wake - time.monotonic()))[0]:
            number = descriptors[descriptor]
            if (message := far.buses[number].recv(0.0)) is not None:
                arrived = occupy(number, time.monotonic())
                for reply in far.answer(number, message):
                    heapq.heappush(pending, (occupy(number, arrived + latency), next(order), number, reply))
