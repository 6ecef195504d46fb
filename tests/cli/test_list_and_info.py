"""`jumper list` and `jumper info` against the files in the policies' folders and the tasks themselves."""

import json
import shutil

import pytest

from cli_helpers import run
from jumper_warp.policies.catalog import add_files
from jumper_warp.registry import TASKS, make_task
from jumper_warp.utils.assets import POLICIES

NAMES = sorted(path.parent.name for path in POLICIES.glob("*/manifest.json"))
ERROR_KEYS = {  # by policy
    "vertical_jump": "in_range_apex_error_abs_mean_m", "horizontal_jump": "in_range_goal_distance_at_rest_mean_m",
    "walking_rough": "settled_rmse_vx_m_s", "attitude": "error_at_end_mean_deg",
}  # fmt: skip


def nominal_metrics(name):
    """Return the metrics of the nominal robot in a shipped policy's metrics.json, by key."""
    rows = json.loads((POLICIES / name / "metrics.json").read_text())["rows"]
    return next(row["metrics"] for row in rows if (row["condition"], row["seed"]) == ("nominal", 0))


def listed(capsys):
    """Return the output of `jumper list --json`: tasks and policies, each by name."""
    code, out, err = run(capsys, "list", "--json")
    assert (code, err) == (0, [])
    return [{entry["name"]: entry for entry in entries} for entries in json.loads(out).values()]


def test_list_has_a_line_about_each_task_and_each_policy(capsys):
    code, out, _ = run(capsys, "list")
    assert code == 0 and max(map(len, out.splitlines())) <= 80
    tasks, policies = (part.splitlines() for part in out.split("\n\n")[:2])
    assert [line.split()[0] for line in tasks[1:] if not line.startswith(" ")] == list(TASKS)
    assert [line.split()[0] for line in policies[1:]] == NAMES
    (line,) = (line for line in policies if line.startswith("vertical_jump "))
    metrics = nominal_metrics("vertical_jump")
    success, error = (metrics[f"in_range_{key}"]["value"] for key in ("success_rate", "apex_error_abs_mean_m"))
    assert line.split()[1:] == ["vertical-jump-standing", f"{100 * success:.1f}", "%", f"{error:.2g}", "m", "527", "kB"]
    assert (POLICIES / "vertical_jump/policy.onnx").stat().st_size // 1000 == 526


def test_listed_values_are_those_of_metrics_json(capsys):
    tasks, policies = listed(capsys)
    assert list(tasks) == list(TASKS) and list(policies) == NAMES
    for name, key in ERROR_KEYS.items():
        assert policies[name]["error"] == nominal_metrics(name)[key]
    assert (
        policies["attitude"]["success_rate"] == nominal_metrics("attitude")["settled_without_collision_rate"]["value"]
    )
    assert policies["walking_rough"]["success_rate"] == 1.0 - nominal_metrics("walking_rough")["fall_rate"]["value"]
    assert tasks["horizontal-jump-mars-loose"]["policies"] == ["mars_horizontal_jump", "mars_springs_jump"]
    assert tasks["velocity-flat"]["aliases"] == ["Olympus-Walk"]


@pytest.mark.parametrize("name", NAMES)
def test_info_of_a_policy_fits_a_screen_and_has_its_metrics(capsys, name):
    code, out, err = run(capsys, "info", name)
    lines = out.splitlines()
    assert (code, err) == (0, []) and len(lines) <= 40
    assert max(len(line) for line in lines if not line.startswith(("folder", "picture"))) <= 80
    (nominal,) = (line.split() for line in lines if line.startswith("nominal "))
    metrics = nominal_metrics(name)
    rate = metrics.get("success_rate", metrics.get("settled_without_collision_rate"))
    if rate is not None:
        assert nominal[1] == f"{100 * rate['value']:.1f}"
    assert f"evaluate      jumper evaluate {name}" in lines
    assert json.loads(run(capsys, "info", name, "--json")[1])["rows"][0]["metrics"] == metrics


@pytest.mark.parametrize("name", ["vertical-jump", "velocity_trot", "Olympus-Walk", "attitude"])
def test_info_of_a_task_has_its_sizes_terms_and_policies(capsys, name):
    task, flag = make_task(name), ["--task"] if name == "attitude" else []
    code, out, _ = run(capsys, "info", name, *flag)
    assert code == 0 and max(map(len, out.splitlines())) <= 80 and len(out.splitlines()) <= 40
    assert f"train         jumper train {task.name}" in out and f"{len(task.observation_names)} numbers" in out
    content = json.loads(run(capsys, "info", name, "--json", *flag)[1])
    assert content["rewards"] == {term.name: term.numbers["weight"] for term in task.rewards}
    assert content["terminations"] == [term.name for term in task.terminations]
    assert content["observation_sizes"]["actor"] == len(task.observation_names)


def test_info_refuses_metrics_that_differ_from_the_manifest(tmp_path, capsys):
    folder = tmp_path / "altered"
    shutil.copytree(POLICIES / "vertical_jump", folder)
    text = (folder / "metrics.json").read_text()
    (folder / "metrics.json").write_text(text.replace('"value": 1.0', '"value": 0.9', 1))
    code, out, err = run(capsys, "info", str(folder))
    assert (code, out) == (2, "") and "metrics.json: truncated or altered" in err[0]


@pytest.mark.parametrize("target", ["../secret.md", "README.md", "/dev/zero"])
def test_info_refuses_a_page_that_is_a_link_to_another_folder(tmp_path, capsys, target):
    (tmp_path / "secret.md").write_text("secret")
    folder = shutil.copytree(POLICIES / "attitude", tmp_path / "mine")
    (folder / "README.md").unlink()
    (folder / "README.md").symlink_to(target)
    code, out, err = run(capsys, "info", str(folder))
    assert (code, out) == (2, "") and len(err) == 1 and "README.md" in err[0]


@pytest.mark.parametrize("change", [{"trials": "4"}, {"value": [1]}, {"unit": 3}])
def test_info_refuses_metrics_of_another_type(tmp_path, capsys, change):
    folder = shutil.copytree(POLICIES / "attitude", tmp_path / "mine")
    metrics = json.loads((folder / "metrics.json").read_text())
    next(iter(metrics["rows"][0]["metrics"].values())).update(change)
    add_files(folder, {"metrics.json": json.dumps(metrics).encode()})
    code, out, err = run(capsys, "info", str(folder))
    assert (code, out) == (2, "") and len(err) == 1 and "metrics.json: metrics of another type" in err[0]
