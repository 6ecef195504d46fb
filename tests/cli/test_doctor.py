"""`jumper doctor`: its text, and the exit code where a device fails."""

import pytest
import torch
import warp as wp

from cli_helpers import run
from jumper_warp.envs.env import Env
from jumper_warp.utils.runtime import init_warp


@pytest.fixture(autouse=True)
def restored(monkeypatch):
    """Restore Warp's log level after a test, to what it is once Warp runs."""
    init_warp()
    monkeypatch.setattr(wp.config, "log_level", wp.config.log_level)


def test_prints_versions_and_a_step_on_each_device(capsys):
    code, out, _ = run(capsys, "doctor")
    rows = dict(line.split(None, 1) for line in out.splitlines())
    assert code == 0 and rows["torch"] == torch.__version__ and rows["newton"] and rows["rerun-sdk"]
    assert all("built and stepped 64 worlds" in rows[str(device)] for device in wp.get_devices())


def test_device_that_fails_is_reported_and_the_exit_code_is_1(capsys, monkeypatch):
    def fail(*args, **kwargs):
        raise RuntimeError("no kernel image\nis available")

    monkeypatch.setattr(Env, "__init__", fail)
    code, out, err = run(capsys, "doctor")
    rows = dict(line.split(None, 1) for line in out.splitlines())
    assert (code, err) == (1, []) and rows["cpu"] == "FAILED: RuntimeError: no kernel image is available"
