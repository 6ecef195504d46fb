"""`jumper doctor`: its text and JSON, and the exit code where a device fails."""

import json

import pytest
import warp as wp

from cli_helpers import run
from jumper_warp.cli import doctor
from jumper_warp.envs import term_check
from jumper_warp.envs.env import Env


@pytest.fixture(autouse=True)
def restored(monkeypatch):
    """Restore Warp's log level after a test; step for a short time."""
    monkeypatch.setattr(wp.config, "log_level", wp.config.log_level)
    monkeypatch.setattr(doctor, "SECONDS", 0.01)


@pytest.fixture
def working_folder(monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    return tmp_path


def test_json_has_versions_folders_and_the_rate_of_each_device(capsys, working_folder):
    code, out, _ = run(capsys, "doctor", "--json")
    content = json.loads(out)
    assert code == 0 and [device["alias"] for device in content["devices"]] == [str(d) for d in wp.get_devices()]
    for device in content["devices"]:
        assert device["error"] is None and device["steps_per_second"] > 0.0 and device["build_s"] > 0.0
    assert {"python", "jumper-warp", "warp-lang", "newton", "torch", "numpy", "mujoco", "rerun-sdk"} <= {
        name for name, version in content["versions"].items() if version
    }
    folders = content["folders"]
    assert folders["working"]["path"] == str(working_folder) and folders["working"]["writable"] is True
    assert folders["kernels"]["size_bytes"] > 0 and content["threads"]["simulation"] >= 1
    assert list(working_folder.iterdir()) == []


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
    assert rows["torch"] and rows["threads"].startswith("cores ") and "OpenGL" in rows


def test_folders_that_are_missing_or_cannot_be_written(monkeypatch, tmp_path):
    (tmp_path / "cache").mkdir()
    (tmp_path / "cache" / "file").write_bytes(b"12345")
    found = doctor.describe_folder(tmp_path / "cache")
    assert (found["size_bytes"], found["writable"], found["exists"]) == (5, True, True)
    missing = doctor.describe_folder(tmp_path / "cache" / "none" / "deep")
    assert (missing["size_bytes"], missing["writable"], missing["exists"]) == (None, True, False)

    def refuse(**arguments):
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(doctor.tempfile, "TemporaryFile", refuse)
    assert doctor.describe_folder(tmp_path / "cache")["writable"] is False


def test_missing_opengl_is_reported_without_a_fault(monkeypatch):
    def refuse():
        raise ImportError("no pyglet")

    monkeypatch.setattr("jumper_warp.viz.renderer.opengl_name", refuse)
    assert doctor.opengl() == {"name": None, "error": "ImportError: no pyglet"}
