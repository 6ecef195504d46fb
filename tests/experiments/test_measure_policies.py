"""Conditions, tables and comparisons of the shipped policies, and the experiment at a tiny size."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
import scipy.stats

from experiments import measure_policies
from jumper_warp.cli.main import main as jumper
from jumper_warp.evaluation.evaluations import EVALUATIONS
from jumper_warp.evaluation.run import EvaluationRun
from jumper_warp.policies.conditions import Conditions
from jumper_warp.policies.folder import load_policy
from jumper_warp.robot.overlay import with_springs
from jumper_warp.utils.assets import POLICIES
from jumper_warp.utils.errors import InputError
from jumper_warp.utils.metrics import MetricValue, mean, rate
from jumper_warp.utils.output import read_metrics
from support import policy_results
from support.policy_comparisons import OldKey, _old_cell, means_p, proportions_p, seed_section, seed_tests
from support.policy_conditions import CONDITIONS, payload_overlay, undefined, with_trials
from support.policy_results import Row

pytestmark = pytest.mark.usefixtures("one_thread")


# ---------------------------------------------------------------- conditions


def test_payload_keeps_springs_and_moves_the_mass_towards_the_centre_of_the_base():
    robot = payload_overlay(with_springs(600.0, 0.2), 3.0).robots()
    np.testing.assert_allclose(robot.base_mass, [[9.43]])
    np.testing.assert_allclose(robot.base_com, [[-0.0094 * 6.43 / 9.43, 0.0, 0.0111 * 6.43 / 9.43]])
    np.testing.assert_allclose(robot.base_mass / 6.43 * robot.base_inertia, 1.0)  # what the model scales inertia by
    assert robot.spring_stiffness[0, 0] == 600.0


def test_condition_is_undefined_only_where_its_change_does_nothing():
    tasks = {name: EvaluationRun(name).task for name in ("vertical_jump", "walking_flat", "attitude")}
    reasons = {name: [key for key in CONDITIONS if undefined(task, key)] for name, task in tasks.items()}
    assert reasons == {
        "vertical_jump": [],
        "walking_flat": ["push_in_flight"],
        "attitude": ["friction_0.4", "push_in_flight"],
    }


@pytest.mark.parametrize(("suite", "count"), [("apex_height", 300), ("omnidirectional", 300), ("attitude", 300),
                                              ("velocity", 2 * 5**3 + 64)])  # fmt: skip
def test_evaluations_have_at_least_the_requested_trials(suite, count):
    flags = with_trials(EVALUATIONS[suite].flags, 300)
    assert flags.log(EvaluationRun("walking_flat").task if suite == "velocity" else jump_task(), 0).count == count


def jump_task():
    """Return the task of a jump with the terminations of its evaluation."""
    run = EvaluationRun("vertical_jump")
    return run.evaluation.prepare_task(run.task)


def test_all_conditions_can_be_built():
    for condition in CONDITIONS.values():
        Conditions(**{name: value for name, value in condition.values.items() if name != "payload"})


# ---------------------------------------------------------------- two seeds


def test_p_of_rates_is_that_of_the_chi_square_test():
    a, b = (rate(np.arange(n) < k) for k, n in ((510, 1000), (600, 1100)))
    table = [[510, 490], [600, 500]]
    assert proportions_p(a, b) == pytest.approx(scipy.stats.chi2_contingency(table, correction=False).pvalue)
    assert proportions_p(rate(np.ones(50)), rate(np.ones(60))) == 1.0


def test_p_of_means_is_that_of_welchs_test_of_the_trials():
    rng = np.random.default_rng(0)
    samples = [rng.normal(0.0, 1.0, 40), rng.normal(0.6, 2.0, 30)]
    errors = [1.959964 * x.std(ddof=1) / np.sqrt(len(x)) for x in samples]
    metrics = [
        MetricValue(x.mean(), len(x), (x.mean() - e, x.mean() + e)) for x, e in zip(samples, errors, strict=True)
    ]
    assert means_p(*metrics) == pytest.approx(scipy.stats.ttest_ind(*samples, equal_var=False).pvalue)
    same = MetricValue(1.0, 50, (1.0, 1.0))
    assert means_p(same, same) == 1.0 and means_p(same, MetricValue(2.0, 50, (2.0, 2.0))) == 0.0


def row(seed, successes, condition="nominal", trials=1000):
    """Return a row with a rate, a mean that is the same for all seeds, and a largest value."""
    metrics = {"success_rate": rate(np.arange(trials) < successes), "error_mean_m": mean(np.arange(trials)),
               "error_max_m": MetricValue(float(seed), trials)}  # fmt: skip
    return Row("vertical_jump", condition, seed, {}, metrics, {})


def test_seeds_are_compared_by_all_metrics_with_an_interval_and_enough_trials():
    rows = [row(0, 500), row(1, 580), row(0, 9, "mujoco"), row(0, 1, "randomised", 19), row(1, 18, "randomised", 19)]
    tests = seed_tests(rows)
    assert [(test.condition, test.key, test.values) for test in tests] == [
        ("nominal", "success_rate", (0.5, 0.58)), ("nominal", "error_mean_m", (499.5, 499.5)),
    ]  # fmt: skip
    assert tests[0].p == pytest.approx(3.3e-4, rel=0.02)  # z = 0.08 / sqrt(2 * 0.54 * 0.46 / 1000) = 3.59


def test_differences_are_significant_after_correction_for_the_number_of_tests():
    assert "**1 differences are significant.**" in seed_section([row(0, 500), row(1, 580)])
    many = [row(seed, 500, condition) for condition in CONDITIONS for seed in (0, 1) if condition != "nominal"]
    text = seed_section([row(0, 500), row(1, 565), *many])  # p = 0.0036, of 20 tests
    assert "10 rows have two seeds. They give 20 tests" in text and "**0 differences are significant.**" in text


# ---------------------------------------------------------------- old and new definitions


@pytest.mark.parametrize(("old", "change", "commands", "text"), [
    (0.5, "other definition", True, "50.0 % → 50.0 %"), (0.9, "other definition", True, "90.0 % → 50.0 % DC"),
    (0.9, "", True, "90.0 % → 50.0 % C"), (0.9, "", False, "90.0 % → 50.0 % S"), (None, "", False, "–"),
])  # fmt: skip
def test_old_value_outside_the_interval_has_its_reason(old, change, commands, text):
    key = OldKey("success", "success_rate", "success_rate", change)
    assert _old_cell(key, old, rate(np.arange(100) < 50), commands) == text


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
    assert read_metrics(row_folder) == read_metrics(tmp_path)


def test_page_has_a_line_for_each_row_and_reasons_for_missing_ones(measured, tmp_path):
    args, _ = measured
    flags = {"out": args.out, "policies": args.policies, "write_tables": tmp_path}
    assert measure_policies.main(measure_policies.Args(**flags)) == 5
    text = (tmp_path / "results.md").read_text()
    metrics = read_metrics(args.out / "vertical_jump/payload_3_kg-0")
    (line,) = [line for line in text.splitlines() if line.startswith("| payload of 3 kg") and "0.5 to 1.2 m" in line]
    success, error = metrics["success_rate"].value, metrics["apex_error_abs_mean_m"].value
    assert f"| {100.0 * success:.1f} % (" in line and f"| {error:.4f} / " in line
    assert "Not measured: randomised, pushed in flight too, since its randomisation has no pushes." in text
    assert "| vertical_jump | nominal | 200 → 16 | 96.5 % → " in text


def test_policies_get_all_rows_and_keep_their_earlier_metrics(measured, tmp_path, monkeypatch):
    args, _ = measured
    for name in args.policies:
        shutil.copytree(POLICIES / name, tmp_path / name)
    monkeypatch.setattr(policy_results, "POLICIES", tmp_path)
    before = policy_results.earlier_metrics("vertical_jump")
    flags = {"out": args.out, "policies": args.policies, "save_to_policies": True}
    for _ in range(2):
        measure_policies.main(measure_policies.Args(**flags))
        load_policy(tmp_path / "vertical_jump")  # verifies checksums
        saved = json.loads((tmp_path / "vertical_jump/metrics.json").read_text())
        assert saved["earlier"] == {"definition": "old definition", "suites": before}
        assert [row["condition"] for row in saved["rows"]] == ["nominal", "payload_3_kg", "push_in_flight"]
    conditions = saved["rows"][1]["conditions"]
    assert conditions["payload_kg"] == 3.0 and "robot" not in conditions
    assert saved["rows"][1]["metrics"]["success_rate"]["trials"] == 16
    jsonschema = pytest.importorskip("jsonschema")
    schema = json.loads((Path(__file__).parents[2] / "docs/metrics.schema.json").read_text())
    jsonschema.validate(saved, schema)
    del saved["rows"][0]["metrics"]
    with pytest.raises(jsonschema.ValidationError):
        jsonschema.validate(saved, schema)


def test_refuses_invalid_flags(tmp_path):
    with pytest.raises(InputError, match="no 'high_jump'; there are attitude"):
        measure_policies.Args(policies=("high_jump",))
    with pytest.raises(InputError, match="at least 16 trials"):
        measure_policies.Args(trials=15)
    with pytest.raises(InputError, match="has no rows"):
        measure_policies.main(measure_policies.Args(out=tmp_path, write_tables=tmp_path))
