"""Simulated far end in real time: frames take their wire time, and the physics keeps up with the clock."""

from __future__ import annotations

import heapq
import itertools
import select
import time
from contextlib import suppress

import can

from jumper_warp.bench.bus_sim import BusSim
from jumper_warp.deploy.realtime import real_time, uncollected

WIRE_TIME = 1.2e-4  # [s] of a frame of 8 bytes at 1 Mbit/s
SHIFT = 5.0e-5  # [s] Largest shift of a physics step toward the middle between the runtime's ticks


def serve_in_real_time(far: BusSim, seconds: float, latency: float) -> None:
    """Answer commands as they arrive, and advance the simulation by a tick each far.dt [s].

    A frame occupies its bus for WIRE_TIME. latency: of a motor's reply [s]. Motors reply with the state of the last
    physics step; the steps take place between the runtime's ticks, so that no reply waits for one.
    """
    events: list[tuple[float, int, int, int, can.Message, bool]] = []  # time, id, order, bus, frame, whether it is sent
    order = itertools.count()
    free = [0.0] * len(far.buses)  # time from which each bus is free
    descriptors = {bus.fileno(): number for number, bus in enumerate(far.buses)}
    start = due = time.monotonic()

    def add(at: float, number: int, message: can.Message, *, sent: bool = False) -> None:
        """Add a frame that is ready, or has passed its bus, at a time; of several frames the lowest id comes first."""
        heapq.heappush(events, (at, message.arbitration_id, next(order), number, message, sent))

    with real_time(), uncollected():
        while due - start < seconds:
            now = time.monotonic()
            while events and events[0][0] <= now:
                at, _, _, number, message, sent = heapq.heappop(events)
                if sent:
                    with suppress(can.CanError):  # nobody listens
                        far.send(far.buses[number], message)
                elif free[number] > at:
                    add(free[number], number, message)
                else:
                    free[number] = at + WIRE_TIME
                    add(free[number], number, message, sent=True)
            if now >= due:
                far.advance()
                far.replies()  # at once, so that none waits for their computation
                for message in far.sensors():
                    add(now, 0, message)
                due = max(due + far.dt, now - 0.1)  # do not catch up after a pause
            wake = min(due, events[0][0] if events else due)
            for descriptor in select.select(list(descriptors), [], [], max(0.0, wake - time.monotonic()))[0]:
                number = descriptors[descriptor]
                if (message := far.buses[number].recv(0.0)) is not None:
                    now = time.monotonic() - (time.time() - message.timestamp)
                    for reply in far.answer(number, message):  # none to an own frame, which multicast returns
                        free[number] = max(free[number], now) + WIRE_TIME
                        add(free[number] + latency, number, reply)
                    if number == 0 and message.arbitration_id == 1:  # first frame of a tick
                        due += max(-SHIFT, min(SHIFT, 0.1 * ((now - due) % far.dt - 0.5 * far.dt)))
