import time

import pytest

from jumper_warp.rl.run_names import newest, run_name, start_time
from jumper_warp.rl.runner import train
from toy_task import PushTask, push_cfg

AUTUMN = 1_792_893_600  # [s] 2026-10-25 03:00 in Oslo, one hour after the clock was set back from 03:00 to 02:00


@pytest.fixture
def zone(monkeypatch):
    """Function that sets the process's time zone."""

    def set_zone(name):
        monkeypatch.setenv("TZ", name)
        time.tzset()

    yield set_zone
    monkeypatch.undo()
    time.tzset()


def test_runs_are_ordered_by_the_instant_of_their_start(zone, tmp_path):
    starts = {"Europe/Oslo": AUTUMN, "America/New_York": AUTUMN + 60, "Asia/Kathmandu": AUTUMN + 30}
    names = {}
    for place, start in starts.items():
        zone(place)
        names[place] = tmp_path / run_name(1_000_000 * start + 7)
    zone("UTC")
    assert {place: start_time(folder) for place, folder in names.items()} == pytest.approx(starts, abs=1.0e-4)
    assert newest(names.values()) == names["America/New_York"]


def test_resume_latest_continues_the_run_that_started_last(zone, tmp_path):
    for place in ("Europe/Oslo", "America/New_York"):
        zone(place)
        run = train(push_cfg(tmp_path, max_iterations=2), PushTask)
    assert train(push_cfg(tmp_path, resume="latest"), PushTask).folder == run.folder
