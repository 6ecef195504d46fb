"""The motor loop after a stall, and replies that come too late for their tick."""

from types import SimpleNamespace

import numpy as np
import pytest

from jumper_warp.deploy import realtime
from jumper_warp.deploy.bus import Link, UnixBus, data_frame, open_buses


def test_tick_after_a_stall_is_late_and_the_next_one_on_time(monkeypatch):
    """A tick is due each 10 ms. The second ends at 54 ms: the third begins 24 ms late, the fourth is due at 60 ms."""
    now, late = [0.0], []

    def sleep(seconds):
        now[0] += seconds

    def monotonic():
        now[0] += 1.0e-6
        return now[0]

    def tick(lateness):
        late.append(lateness)
        sleep(0.034 if len(late) == 2 else 0.001)

    clock = SimpleNamespace(sleep=sleep, monotonic=monotonic, thread_time=lambda: 0.0)
    monkeypatch.setattr(realtime, "time", clock)
    result = realtime.run_loop(tick, 100, 0.1)
    assert late == pytest.approx([0.0, 0.0, 0.024, *[0.0] * (len(late) - 3)], abs=1.0e-4)  # [s]
    assert result["missed"] == pytest.approx(2 / (result["ticks"] + 2))


def test_reply_of_the_tick_before_is_stored_and_not_fresh(tmp_path):
    far = open_buses(f"unix:{tmp_path}", "robot")
    link = Link(open_buses(f"unix:{tmp_path}"), deadline=0.001)
    reply = bytes([2, 11, 12, 13, 14, 15, 16, 17])
    far[1].send(data_frame(0, reply))
    link.send(np.zeros((12, 8), np.uint8))
    record = link.collect()
    assert record["motor"][4].tobytes() == reply
    assert not record["motor_fresh"].any()
    link.close()
    for bus in far:
        bus.shutdown()


def test_own_frames_that_a_bus_returns_are_no_unknown_ones(tmp_path):
    """UDP multicast returns them; the socket that sends them to itself does so too."""
    link = Link([UnixBus(tmp_path / str(leg), tmp_path / str(leg)) for leg in range(4)], deadline=0.001)
    frames = np.arange(96, dtype=np.uint8).reshape(12, 8)
    link.send(frames)
    assert link.collect()["unknown"] == 0
    link.buses[0].send(data_frame(1, bytes([9] * 8)))
    link.send(frames)
    assert link.collect()["unknown"] == 1
    link.close()
