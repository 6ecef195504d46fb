"""`jumper list` and `jumper info` against the files in the policies' folders and the tasks themselves."""

import json
import shutil

import pytest

from cli_helpers import run
from jumper_warp.registry import TASKS, make_task
from jumper_warp.utils.assets import POLICIES

NAMES = sorted(path.parent.name for path in POLICIES.glob("*/manifest.json"))
ERROR_KEYS = {  # by policy
    "vertical_jump": "in_range_apex_error_abs_mean_m", "horizontal_jump": "in_range_goal_distance_at_rest_mean_m",
    "walking": "settled_rmse_vx_m_s", "attitude": "error_at_end_mean_deg",
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


def test_listed_values_are_those_of_metrics_json(capsys):
    tasks, policies = listed(capsys)
    assert list(tasks) == list(TASKS) and list(policies) == NAMES
    for name, key in ERROR_KEYS.items():
        assert policies[name]["error"] == nominal_metrics(name)[key]
    settled = nominal_metrics("attitude")["settled_without_collision_rate"]["value"]
    assert policies["attitude"]["success_rate"] == settled
    assert policies["walking"]["success_rate"] == 1.0 - nominal_metrics("walking")["fall_rate"]["value"]
    assert tasks["horizontal-jump-mars-loose"]["policies"] == ["mars_horizontal_jump", "mars_springs_jump"]
    assert tasks["velocity-flat"]["aliases"] == ["Olympus-Walk"]


@pytest.mark.parametrize("name", NAMES)
def test_info_of_a_policy_has_its_metrics(capsys, name):
    code, out, err = run(capsys, "info", name)
    assert (code, err) == (0, []) and f"evaluate      jumper evaluate {name}" in out.splitlines()
    assert json.loads(run(capsys, "info", name, "--json")[1])["rows"][0]["metrics"] == nominal_metrics(name)


@pytest.mark.parametrize("name", ["vertical-jump", "velocity_trot", "Olympus-Walk"])
def test_info_of_a_task_has_its_sizes_and_terms(capsys, name):
    task, content = make_task(name), json.loads(run(capsys, "info", name, "--json")[1])
    assert content["rewards"] == {term.name: term.numbers["weight"] for term in task.rewards}
    assert content["terminations"] == [term.name for term in task.terminations]
    assert content["observation_sizes"]["actor"] == len(task.observation_names)


def altered(folder):
    """Change a value without its checksum."""
    text = (folder / "metrics.json").read_text()
    (folder / "metrics.json").write_text(text.replace('"value": 1.0', '"value": 0.9', 1))


def linked(folder):
    """Let the page be a link to another folder."""
    (folder / "README.md").unlink()
    (folder / "README.md").symlink_to("/dev/zero")


@pytest.mark.parametrize(
    ("damage", "message"), [(altered, "metrics.json: truncated or altered"), (linked, "README.md")]
)
def test_info_refuses_damaged_files(tmp_path, capsys, damage, message):
    folder = shutil.copytree(POLICIES / "vertical_jump", tmp_path / "mine")
    damage(folder)
    code, out, err = run(capsys, "info", str(folder))
    assert (code, out) == (2, "") and len(err) == 1 and message in err[0]
