import json
import math
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import warp as wp
from rich.console import Console

import jumper_warp
from jumper_warp.utils import output, runtime
from jumper_warp.utils.metrics import MetricValue, unit_of


def test_default_output_folder_is_name_and_time(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    folder = output.output_dir("jump")
    assert folder.is_dir()
    assert folder.parent.as_posix() == "outputs/jump"
    assert [len(part) for part in folder.name.split("_")] == [len("2026-01-31"), len("23-59-59")]  # date_time


def test_two_runs_never_share_a_default_folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert len({output.output_dir("jump") for _ in range(3)}) == 3


def test_folder_that_another_process_makes_at_the_same_time_is_not_shared(tmp_path, monkeypatch):
    make = Path.mkdir

    def make_second(self, **settings):
        if self.name.count("_") == 1:  # date_time, without a number
            os.makedirs(self, exist_ok=True)
        make(self, **settings)

    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(Path, "mkdir", make_second)
    assert output.output_dir("jump").name.endswith("_2")


def test_given_output_folder_is_used_unchanged(tmp_path):
    assert output.output_dir("jump", tmp_path / "a" / "b") == tmp_path / "a" / "b"
    assert output.output_dir("jump", tmp_path / "a" / "b").is_dir()


@pytest.mark.parametrize("name", ["", "..", "a/b", "/tmp"])
def test_refuses_a_name_that_is_not_one_path_component(name):
    with pytest.raises(ValueError, match="one path component"):
        output.output_dir(name)


def test_metrics_file_holds_the_given_metrics(tmp_path):
    metrics = {"apex [m]": 1.075, "worlds": 4096, "method": "open loop", "passed": True, "gap": None, "list": [18.0, 1]}
    path = output.write_metrics(tmp_path, metrics).path
    assert path == tmp_path / "metrics.json"
    assert output.read_values(tmp_path) == metrics


def test_metrics_file_has_documented_layout(tmp_path):
    jsonschema = pytest.importorskip("jsonschema")
    rate = MetricValue(0.5, 4, (0.15, 0.85), "landed jumps")
    output.write_metrics(tmp_path, {"fall_rate": rate, "apex [m]": 1.0, "bin_m": [1.0, None]}, {"solver": "mujoco"})
    schema = json.loads((Path(__file__).parents[2] / "docs" / "metrics.schema.json").read_text())
    document = json.loads((tmp_path / "metrics.json").read_text())
    jsonschema.validate(document, schema)
    with pytest.raises(jsonschema.ValidationError):
        jsonschema.validate(document | {"version": 0}, schema)


def test_metric_has_value_unit_trials_interval_and_set_of_trials(tmp_path):
    report = output.write_metrics(tmp_path, {"drift_m": MetricValue(0.5, 4, (0.1, 0.9), "jumps")}, {"a": 1})
    assert json.loads(report.path.read_text()) == {
        "schema": "jumper-warp metrics", "version": 1, "conditions": {"a": 1},
        "metrics": {"drift_m": {"value": 0.5, "unit": "m", "trials": 4, "interval": [0.1, 0.9], "over": "jumps"}},
    }  # fmt: skip
    assert report.metrics == {"drift_m": MetricValue(0.5, 4, [0.1, 0.9], "jumps")}


def test_a_report_in_memory_is_the_one_in_the_file(tmp_path):
    metrics = {
        "drift_m": MetricValue(np.float32(0.1), 4, (0.1, np.float64(0.9)), "jumps"),
        "bin_m": [np.int64(1), None],
    }
    report = output.write_metrics(tmp_path, metrics, {"seed": np.int32(3)})
    assert output.read_report(tmp_path) == report
    assert report.values == {"seed": 3, "drift_m": float(np.float32(0.1)), "bin_m": [1, None]}


@pytest.mark.parametrize(
    ("key", "unit"),
    [("rmse_vx_m_s", "m/s"), ("spin_rad_s", "rad/s"), ("settling_s", "s"), ("tilt_deg", "deg"), ("jumps", None),
     ("gravity_m_s2", "m/s^2"), ("torque_nm", "N m"), ("steps_per_s", "1/s"), ("stiffness_n_m", "N/m"),
     ("rate [poses/s]", "poses/s"), ("fall_rate", None)],
)  # fmt: skip
def test_unit_is_read_from_the_end_of_the_key(key, unit):
    assert unit_of(key) == unit


def test_numpy_scalars_are_written_as_numbers(tmp_path):
    output.write_metrics(tmp_path, {"a": np.float32(0.5), "b": [np.int64(3)], "c": np.bool_(True)})
    assert output.read_values(tmp_path) == {"a": 0.5, "b": [3], "c": True}


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf, np.float32("nan")])
@pytest.mark.parametrize(("as_metric", "name"), [(lambda x: x, "'apex'"), (lambda x: [0.0, x], r"'apex\[1\]'")])
def test_refuses_a_non_finite_metric_by_name_and_writes_nothing(tmp_path, bad, as_metric, name):
    with pytest.raises(ValueError, match=name):
        output.write_metrics(tmp_path, {"fine": 1.0, "apex": as_metric(bad)})
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("nested", [{"x": 1}, [[1]], np.zeros(2), object()])
def test_refuses_a_nested_metric_by_name(tmp_path, nested):
    with pytest.raises(TypeError, match="apex"):
        output.write_metrics(tmp_path, {"apex": nested})


def test_failed_write_keeps_the_old_metrics(tmp_path, monkeypatch):
    output.write_metrics(tmp_path, {"apex": 1.0})

    def full_disk(*_):
        raise OSError(28, "no space left")

    monkeypatch.setattr(os, "replace", full_disk)
    with pytest.raises(OSError, match="no space left"):
        output.write_metrics(tmp_path, {"apex": 2.0})
    assert output.read_values(tmp_path) == {"apex": 1.0}
    assert sorted(path.name for path in tmp_path.iterdir()) == ["metrics.json", "run.json"]


def test_run_json_has_versions_and_command_but_no_environment_variables(tmp_path, monkeypatch):
    monkeypatch.setenv("SOME_TOKEN", "hush-4711")
    monkeypatch.setattr(sys, "argv", ["/home/someone/experiments/jump.py", "--torque", "18"])
    output.write_metrics(tmp_path, {})
    text = (tmp_path / "run.json").read_text()
    run = json.loads(text)
    assert set(run) == {"commit", "dirty", "versions", "device", "command"}
    assert run["command"] == ["jump.py", "--torque", "18"]
    assert run["versions"]["newton"].startswith("1.8.")
    assert run["device"]["alias"].startswith(("cpu", "cuda"))
    assert "hush" not in text and "/home" not in text


def _git(folder, *arguments):
    """Run git in a folder with a made-up author; return its output."""
    identity = ["-c", "user.name=A", "-c", "user.email=a@example.org", "-c", "commit.gpgsign=false"]
    done = subprocess.run(["git", *identity, *arguments], cwd=folder, check=True, capture_output=True, text=True)
    return done.stdout.strip()


def test_commit_is_none_outside_git_and_before_the_first_commit(tmp_path):
    assert runtime.git_commit(tmp_path) is None
    _git(tmp_path, "init")
    (tmp_path / "file").write_text("1")
    _git(tmp_path, "add", "file")
    assert runtime.git_commit(tmp_path) is None


def test_commit_is_head_and_detects_untracked_files(tmp_path):
    _git(tmp_path, "init")
    (tmp_path / "package").mkdir()
    (tmp_path / "package" / "file").write_text("1")
    _git(tmp_path, "add", ".")
    _git(tmp_path, "commit", "-m", "Begin")
    head = _git(tmp_path, "rev-parse", "HEAD")
    assert runtime.git_commit(tmp_path / "package") == (head, False)
    (tmp_path / "beside").write_text("2")
    assert runtime.git_commit(tmp_path / "package") == (head, True)


def test_commit_is_none_for_an_untracked_folder_of_another_project(tmp_path):
    _git(tmp_path, "init")
    (tmp_path / ".gitignore").write_text(".venv\n")
    _git(tmp_path, "add", ".")
    _git(tmp_path, "commit", "-m", "Begin")
    installed = tmp_path / ".venv" / "jumper_warp"
    installed.mkdir(parents=True)
    assert runtime.git_commit(installed) is None


def test_device_report_is_one_line(monkeypatch):
    monkeypatch.setattr("jumper_warp.utils.threads._default_threads", 3)
    console = Console(record=True, width=40, quiet=False)
    info = runtime.report_device("cpu", console)
    lines = console.export_text().splitlines()
    assert len(lines) == 1
    assert info == ("cpu", info.name, None, False, True)  # alias, name, driver, mempool, graphs
    found = "" if wp.is_cuda_available() else "; no CUDA GPU found"
    assert lines[0] == f"device: cpu (3 threads){found}"


def test_warp_is_initialised_without_its_notice_about_a_missing_gpu():
    code = "import warp as wp; from jumper_warp.utils.runtime import configure_device; configure_device('cpu')"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout == "" and len(done.stderr.splitlines()) == 1 and done.stderr.startswith("device: cpu (")


def test_versions_include_python_and_none_for_a_missing_package(monkeypatch):
    monkeypatch.setattr(runtime, "PACKAGES", ("numpy", "no-such-package-here"))
    version = ".".join(map(str, sys.version_info[:3]))
    packages = {"jumper-warp": jumper_warp.__version__, "numpy": np.__version__, "no-such-package-here": None}
    assert runtime.versions() == {"python": version, **packages}
