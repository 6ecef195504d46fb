import json
import math
import sys
from pathlib import Path

import numpy as np
import pytest

from jumper_warp.utils import output
from jumper_warp.utils.metrics import MetricValue, unit_of


def test_metrics_file_has_documented_layout(tmp_path):
    jsonschema = pytest.importorskip("jsonschema")
    rate = MetricValue(0.5, 4, (0.15, 0.85), "landed jumps")
    output.write_metrics(tmp_path, {"fall_rate": rate, "apex [m]": 1.0, "bin_m": [1.0, None]}, {"solver": "mujoco"})
    schema = json.loads((Path(__file__).parents[2] / "docs" / "metrics.schema.json").read_text())
    document = json.loads((tmp_path / "metrics.json").read_text())
    jsonschema.validate(document, schema)
    with pytest.raises(jsonschema.ValidationError):
        jsonschema.validate(document | {"version": 0}, schema)


@pytest.mark.parametrize(
    ("key", "unit"),
    [("rmse_vx_m_s", "m/s"), ("spin_rad_s", "rad/s"), ("settling_s", "s"), ("tilt_deg", "deg"), ("jumps", None),
     ("gravity_m_s2", "m/s^2"), ("torque_nm", "N m"), ("steps_per_s", "1/s"), ("stiffness_n_m", "N/m"),
     ("rate [poses/s]", "poses/s"), ("fall_rate", None)],
)  # fmt: skip
def test_unit_is_read_from_the_end_of_the_key(key, unit):
    assert unit_of(key) == unit


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf, np.float32("nan")])
@pytest.mark.parametrize(("as_metric", "name"), [(lambda x: x, "'apex'"), (lambda x: [0.0, x], r"'apex\[1\]'")])
def test_refuses_a_non_finite_metric_by_name_and_writes_nothing(tmp_path, bad, as_metric, name):
    with pytest.raises(ValueError, match=name):
        output.write_metrics(tmp_path, {"fine": 1.0, "apex": as_metric(bad)})
    assert list(tmp_path.iterdir()) == []


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
