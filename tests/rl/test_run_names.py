import time

import pytest

from jumper_warp.rl.runner import train
from toy_task import PushTask, push_cfg


@pytest.fixture
def zone(monkeypatch):
    """Function that sets the process's time zone."""

    def set_zone(name):
        monkeypatch.setenv("TZ", name)
        time.tzset()

    yield set_zone
    monkeypatch.undo()
    time.tzset()


def test_resume_latest_continues_the_run_that_started_last(zone, tmp_path):
    for place in ("Europe/Oslo", "America/New_York"):
        zone(place)
        run = train(push_cfg(tmp_path, max_iterations=2), PushTask)
    assert train(push_cfg(tmp_path, resume="latest"), PushTask).folder == run.folder
