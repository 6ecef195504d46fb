"""`jumper doctor`: its text, and the exit code where a device fails."""

import os
import subprocess
import sys

import pytest
import torch
import warp as wp

from cli_helpers import run
from jumper_warp.envs import term_check
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


def test_terms_of_a_task_that_fail_are_named_and_the_exit_code_is_1(capsys, monkeypatch):
    found = {"reset": "", "rewards.mine": "killed by SIGABRT"}
    monkeypatch.setattr(term_check, "check_terms", lambda task: found.items() if task.name == "attitude" else ())
    code, out, err = run(capsys, "doctor", "--task", "attitude")
    assert (code, out.splitlines(), err) == (1, ["reset: ok", "rewards.mine: killed by SIGABRT"], [])


def test_device_that_fails_is_reported_and_the_exit_code_is_1(capsys, monkeypatch):
    def fail(*args, **kwargs):
        raise RuntimeError("no kernel image\nis available")

    monkeypatch.setattr(Env, "__init__", fail)
    code, out, err = run(capsys, "doctor")
    rows = dict(line.split(None, 1) for line in out.splitlines())
    assert (code, err) == (1, []) and rows["cpu"] == "FAILED: RuntimeError: no kernel image is available"


NO_CACHE = "(Not a directory): set WARP_CACHE_PATH to a writable folder"


@pytest.mark.parametrize(
    ("variables", "folder"),
    [({"HOME": "/dev/null"}, "/dev/null/.cache/warp"), ({"WARP_CACHE_PATH": "/dev/null/kernels"}, "/dev/null/kernels")],
)
def test_kernel_cache_that_cannot_be_made_is_named(variables, folder):
    environment = {key: value for key, value in os.environ.items() if key not in ("WARP_CACHE_PATH", "XDG_CACHE_HOME")}
    command, environment = [sys.executable, "-m", "jumper_warp", "doctor"], environment | variables
    done = subprocess.run(command, capture_output=True, text=True, env=environment)
    message = f"jumper: kernel cache {folder}/{wp.config.version} cannot be written {NO_CACHE}\n"
    assert (done.returncode, done.stdout) == (2, "") and done.stderr.endswith(message)
