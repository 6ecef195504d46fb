"""Conditions and tables of the shipped policies, and the experiment at a tiny size."""

import json
import re
import shutil
from datetime import date

import numpy as np
import pytest

from docs.policy_tables import MEASURED, filled, pages
from experiments import measure_policies
from experiments.measure_policies import payload_overlay, with_trials
from jumper_warp.cli.main import main as jumper
from jumper_warp.evaluation.attitude import AttitudeFlags
from jumper_warp.evaluation.jump_metrics import HeightFlags
from jumper_warp.evaluation.run import EvaluationRun
from jumper_warp.evaluation.velocities import VelocityFlags
from jumper_warp.policies.policy import load_policy
from jumper_warp.robot.overlay import RobotOverlay
from jumper_warp.utils.assets import POLICIES, policy_tasks
from metric_helpers import saved_metrics
from support import policy_results
from support.policy_results import CONDITIONS, saved_rows, tasks_of, undefined

pytestmark = pytest.mark.usefixtures("one_thread")


# ---------------------------------------------------------------- conditions


def test_payload_keeps_springs_and_moves_the_mass_towards_the_centre_of_the_base():
    base, payload = 6.43, 3.0  # [kg]; the payload is at the base's origin
    robot = payload_overlay(RobotOverlay({"spring_stiffness": (600.0,), "spring_length": (0.2,)}), payload).robots()
    share = base / (base + payload)
    np.testing.assert_allclose(robot.base_mass, [[base + payload]])
    np.testing.assert_allclose(robot.base_com, [[-0.0094 * share, 0.0, 0.0111 * share]])  # [m]
    np.testing.assert_allclose(robot.base_mass / base * robot.base_inertia, 1.0)  # what the model scales inertia by
    assert robot.spring_stiffness[0, 0] == 600.0


@pytest.mark.parametrize("trials", [1, 5, 300])
def test_every_kind_of_test_has_at_least_the_wanted_number_of_trials(trials):
    jumps, turns, walks = (with_trials(flags(), trials) for flags in (HeightFlags, AttitudeFlags, VelocityFlags))
    assert jumps.num_jumps == trials and turns.num_turns == max(trials, 6)
    assert walks.commands_per_axis == {1: 2, 5: 2, 300: 5}[trials]  # 2 n^3 walks, and 64 that stand


def test_condition_is_undefined_only_where_its_change_does_nothing():
    tasks = {name: EvaluationRun(name).task for name in ("vertical_jump", "walking", "attitude")}
    reasons = {name: [key for key in CONDITIONS if undefined(task, key)] for name, task in tasks.items()}
    assert reasons == {
        "vertical_jump": [],
        "walking": ["push_in_flight"],
        "attitude": ["friction_0.4", "push_in_flight"],
    }


# ---------------------------------------------------------------- tables of the pages


@pytest.fixture(scope="module")
def tasks():
    """Tasks of all shipped policies by name."""
    return tasks_of(policy_tasks())


@pytest.mark.parametrize("page", pages(), ids=lambda page: f"{page.parent.name}-{page.stem}")
def test_tables_of_the_pages_are_those_of_metrics_json(page, tasks):
    text = page.read_text(encoding="utf-8")
    assert filled(text, tasks) == text, "run python -m docs.policy_tables"


def test_measured_rows_have_machine_commit_and_date_and_their_tables_are_on_pages():
    text = "".join(page.read_text(encoding="utf-8") for page in pages())
    for name, table in MEASURED.items():
        assert f"<!-- table: measured {name} -->" in text
        for row in table["rows"]:
            assert row["machine"] and len(row["cells"]) == len(table["columns"]), row
            assert re.fullmatch(r"[0-9a-f]{8}", row["commit"]) and date.fromisoformat(row["date"]), row


# ---------------------------------------------------------------- the experiment


@pytest.fixture(scope="module")
def measured(tmp_path_factory):
    """Folder with rows of 16 trials: two policies, three conditions; and the number of rows."""
    folder = tmp_path_factory.mktemp("rows")
    args = measure_policies.Args(
        out=folder, policies=("attitude", "vertical_jump"), conditions=("nominal", "payload_3_kg", "push_in_flight"),
        trials=16, device="cpu", seeds=(0,),
    )  # fmt: skip
    return args, measure_policies.main(args)


def test_rows_are_measured_once_where_they_are_defined(measured):
    args, count = measured
    names = sorted(str(path.parent.relative_to(args.out)) for path in args.out.glob("*/*/metrics.json"))
    assert names == ["attitude/nominal-0", "attitude/payload_3_kg-0", "vertical_jump/nominal-0",
                     "vertical_jump/payload_3_kg-0", "vertical_jump/push_in_flight-0"]  # fmt: skip
    assert count == 5 and measure_policies.main(args) == 0


def test_rows_have_the_metrics_of_jumper_evaluate(measured, tmp_path):
    flags = ["--num-jumps", "16", "--randomize", "--noise", "--push-in-flight", "--device", "cpu"]
    assert jumper(["evaluate", "vertical_jump", *flags, "--out", str(tmp_path)]) in (0, None)
    row_folder = measured[0].out / "vertical_jump/push_in_flight-0"
    assert saved_metrics(row_folder) == saved_metrics(tmp_path)


def test_policies_get_new_rows_and_keep_their_other_rows_and_earlier_metrics(measured, tmp_path, monkeypatch):
    args, _ = measured
    for name in args.policies:
        shutil.copytree(POLICIES / name, tmp_path / name)
    monkeypatch.setattr(policy_results, "POLICIES", tmp_path)
    before = json.loads((tmp_path / "vertical_jump/metrics.json").read_text())["earlier"]["suites"]
    kept = [row[1:3] for row in saved_rows("vertical_jump")]
    flags = {"out": args.out, "policies": args.policies, "save_to_policies": True}
    for _ in range(2):
        measure_policies.main(measure_policies.Args(**flags))
        load_policy(tmp_path / "vertical_jump")  # verifies checksums
        saved = json.loads((tmp_path / "vertical_jump/metrics.json").read_text())
        assert saved["earlier"] == {"definition": "old definition", "suites": before}
        assert [(row["condition"], row["seed"]) for row in saved["rows"]] == kept
    rows = {(row["condition"], row["seed"]): row for row in saved["rows"]}
    payload, other = rows["payload_3_kg", 0], rows["friction_0.4", 0]
    assert payload["conditions"]["payload_kg"] == 3.0 and "robot" not in payload["conditions"]
    assert [row["metrics"]["success_rate"]["trials"] for row in (payload, other)] == [16, 1024]
