import json

import numpy as np
import pytest

from closed_pipe import closed_pipe
from jumper_warp.cli.main import main
from jumper_warp.compare.arms import find_arms
from jumper_warp.compare.comparison import compare
from jumper_warp.compare.report import DATA, PAGE, PICTURE, markdown, write_report
from jumper_warp.evaluation.run import EvaluationRun
from jumper_warp.recipe import Recipe
from jumper_warp.rl.metrics_file import METRICS_FILE
from jumper_warp.rl.run_folder import CONFIG
from jumper_warp.rl.run_names import FROZEN
from jumper_warp.utils.errors import InputError


def save_run(root, name, seed, success, *, weight=None, rewards=None, start=0):
    """Write the run `name` of a seed with logged successes, and return its folder; rewards: last terms by name."""
    recipe = Recipe.of("vertical-jump").to_json()
    recipe["train"] |= {"seed": seed, "run_name": name, "num_envs": 8}
    if weight is not None:
        recipe["env"]["task"]["rewards"][0]["weight"] = weight
    folder = root / "vertical-jump" / f"2026-01-01_00-00-{start:02d}_00000{seed}+0000_{name}"
    folder.mkdir(parents=True)
    (folder / CONFIG).write_text(json.dumps(recipe))
    rows = [
        {"iteration": 10 * (i + 1), "Perf/elapsed_s": 2.0 * (i + 1), "Metrics/success": value}
        | {f"Episode_Reward/{term}": reward for term, reward in (rewards or {}).items()}
        for i, value in enumerate(success)
    ]
    (folder / METRICS_FILE).write_text("".join(json.dumps(row) + "\n" for row in rows))
    return folder


@pytest.fixture
def runs(tmp_path):
    for seed in range(1, 6):
        save_run(tmp_path, "base", seed, [0.1, 0.5 + 0.01 * seed], rewards={"tuck": 0.0, "height": 1.0})
        save_run(tmp_path, "tuck", seed, [0.2, 0.8 + 0.01 * seed], weight=7.0, rewards={"tuck": 0.3})
    return tmp_path / "vertical-jump"


def compared(runs, *sources, **settings):
    return compare(*(runs / source for source in sources), evaluate=False, **settings)


def test_runs_of_one_name_are_an_arm(runs):
    arms = find_arms([runs])
    assert [(arm.name, arm.seeds) for arm in arms] == [("base", [1, 2, 3, 4, 5]), ("tuck", [1, 2, 3, 4, 5])]


def test_the_newest_run_of_a_name_and_seed_counts(runs):
    newer = save_run(runs.parent, "base", 3, [0.9], start=7)
    (arm,) = find_arms([runs / "bas*"])
    assert arm.seeds == [1, 2, 3, 4, 5]
    assert arm.members[2].folder == newer


def test_runs_of_an_arm_must_have_equal_settings(runs):
    with pytest.raises(InputError, match=r"runs named both differ in env\.rewards\.jump-height\.weight"):
        find_arms([f"both={runs}"])


@pytest.mark.parametrize(
    ("sources", "settings", "message"),
    [
        (("bass*", "tuck"), {}, "no such run"),
        (("base",), {}, "a comparison needs two arms, got base"),
        (("base", "tuck", ".."), {}, "no run in this folder"),
        (("base", "tuck", "several:7"), {}, "no seed 7; seeds: 1, 2"),
        (("base", "broken"), {}, "no settings of a training"),
        (("base", "no_seed"), {}, r"config\.json: no settings of a training"),
        (("base", "tuck"), {"primary": "success"}, "there are iteration, Perf/elapsed_s, Metrics/success"),
        (("base", "tuck"), {"metric": "success"}, "no run has logged success; base has logged iteration"),
    ],
)
def test_sources_and_metrics_that_do_not_exist_are_refused(runs, sources, settings, message):
    for name in ("seed_1", "seed_2"):
        (runs / "several" / name).mkdir(parents=True)
    saved = json.loads((next(runs.glob("*_base")) / "config.json").read_text())
    for name, config in (("broken", None), ("no_seed", saved | {"train": saved["train"] | {"seed": None}})):
        (runs / name).mkdir()
        (runs / name / "config.json").write_text(json.dumps(config))
    with pytest.raises(InputError, match=message):
        _ = compared(runs, *sources, **settings).primary


def test_separated_arms_of_five_seeds_differ(runs):
    comparison = compared(runs, "base", "tuck")
    base, tuck = comparison.primary
    assert base.p_value is None
    assert tuck.verdict == "better"
    assert tuck.improvement == 1.0
    assert tuck.mean == pytest.approx(0.83)
    assert tuck.p_value == pytest.approx(2.0 / 252.0)


def test_a_minus_sign_makes_smaller_values_better(runs):
    _, tuck = compared(runs, "base", "tuck", primary="-Metrics/success").primary
    assert (tuck.verdict, tuck.improvement) == ("worse", 0.0)


def test_rows_of_rewards_have_no_test_and_skip_arms_without_the_term(runs):
    rows = compared(runs, "base", "tuck").rewards
    assert [(row.metric.split("/")[1], row.arm) for row in rows] == [
        ("tuck", "base"), ("tuck", "tuck"), ("height", "base"),
    ]  # fmt: skip
    assert all(row.p_value is None for row in rows)


def test_learning_curves_are_interpolated_by_steps_and_time(runs):
    (arm, _) = compared(runs, "base", "tuck").arms
    for axis, ends in ((0, (1920.0, 3840.0)), (1, (2.0, 4.0))):
        x, values = arm.curves("Metrics/success", axis, points=3)
        assert (x[0], x[-1]) == pytest.approx(ends if axis else (8 * arm.settings["ppo.num-steps"] * 10, x[-1]))
        np.testing.assert_allclose(values[0], [0.1, 0.305, 0.51])


def test_the_page_shows_the_changes_of_the_users_files(runs):
    for name, weight in (("base", 1), ("tuck", 2)):
        for folder in runs.glob(f"*_{name}"):
            (folder / "sources").mkdir()
            (folder / "sources/my_task.py").write_text(f"import warp\nWEIGHT = {weight}\n")
    page = markdown(compared(runs, "base", "tuck"))
    assert "### my_task.py of tuck" in page
    assert "\n import warp\n-WEIGHT = 1\n+WEIGHT = 2\n" in page


def test_policies_are_evaluated_with_changed_flags():
    comparison = compare("vertical_jump", "mars_vertical_jump", evaluation={"num_jumps": 4})
    assert comparison.primary_name == "success_rate"
    assert [len(row.values) for row in comparison.primary] == [1, 1]
    assert any(row.metric == "apex_error_abs_mean_m" for row in comparison.exploratory)


@pytest.mark.parametrize(
    "line", [b"null", b'{"iteration": 3', b"\xff", b'{"iteration": 3, "a": "x"}', b'{"iteration": 3, "a": 1e308}']
)
def test_a_malformed_line_of_metrics_is_named(runs, line):
    folder = save_run(runs.parent, "base", 3, [0.9], start=7)
    (folder / METRICS_FILE).write_bytes(line + b"\n")
    with pytest.raises(InputError, match=f"{METRICS_FILE} line 1: malformed"):
        compared(runs, "base", "tuck")


def test_an_unfinished_line_of_metrics_does_not_count(runs):
    folder = save_run(runs.parent, "base", 3, [0.9], start=7)
    before = (folder / METRICS_FILE).read_bytes()
    (folder / METRICS_FILE).write_bytes(before + b'{"iteration": 20, "Metr')
    assert compared(runs, "base", "tuck").primary[0].values[2] == 0.9


def test_the_steps_to_a_share_can_be_the_primary_metric(runs):
    primary = compared(runs, "base", "tuck", primary="-steps_to_80_percent").primary
    base, tuck = primary
    steps = [member.curve("Metrics/success")[0] for member in find_arms([runs / "base"])[0].members]
    np.testing.assert_array_equal(base.values, [each[-1] for each in steps])  # none reaches 80 %
    assert tuck.improvement == pytest.approx(0.5)
    first = compared(runs, "base", "tuck", primary="-steps_to_15_percent").primary[1]
    assert (first.improvement, first.verdict) == (1.0, "better")


def test_steps_to_a_share_are_limited_to_the_shortest_run(runs):
    """A short run that never reaches the share is not better than a long run that reaches it late."""
    for seed in range(1, 6):
        save_run(runs.parent, "short", seed, [0.1])
        save_run(runs.parent, "long", seed, [0.1, 0.9])
    long, short = compared(runs, "long", "short", primary="-steps_to_80_percent").primary
    np.testing.assert_array_equal(short.values, long.values)
    assert short.values[0] == find_arms([runs / "short"])[0].members[0].steps * 10


def test_a_frozen_seed_does_not_shorten_the_other_runs(runs):
    frozen = save_run(runs.parent, "base", 6, [0.1])
    (frozen / FROZEN).write_text("iteration 10: the weights are not finite\n")
    base, tuck = compared(runs, "base", "tuck").primary
    np.testing.assert_allclose(base.values, [0.51, 0.52, 0.53, 0.54, 0.55, 0.1])
    np.testing.assert_allclose(tuck.values, [0.81, 0.82, 0.83, 0.84, 0.85])


def test_a_missing_primary_metric_is_refused_after_the_first_seed(monkeypatch):
    evaluated = []
    run_episodes = EvaluationRun.run_episodes

    def counted(run, *args, **settings):
        evaluated.append(run)
        return run_episodes(run, *args, **settings)

    monkeypatch.setattr(EvaluationRun, "run_episodes", counted)
    with pytest.raises(InputError, match=r"vertical_jump has no metric sucess_rate; there are .*success_rate"):
        compare("vertical_jump", "mars_vertical_jump", primary="-sucess_rate", evaluation={"num_jumps": 4})
    assert len(evaluated) == 1


def test_a_seed_without_the_metric_of_the_best_checkpoint_has_no_steps_to_a_share(runs, tmp_path):
    path = next(runs.glob("*_base")) / METRICS_FILE
    path.write_text('{"iteration": 10, "Metrics/success": null}\n{"iteration": 20}\n')
    comparison = compared(runs, "base", "tuck", primary="-steps_to_80_percent")
    assert len(comparison.primary[0].values) == 4
    assert write_report(comparison, tmp_path).exists()


def test_lines_of_metrics_without_a_time_have_no_curve_over_time(runs, tmp_path):
    for folder in runs.glob("*_base"):
        (folder / METRICS_FILE).write_text('{"iteration": 10, "Metrics/success": 0.5}\n')
    assert write_report(compared(runs, "base", "tuck"), tmp_path).exists()


def test_a_reader_that_closes_the_pipe_does_not_lose_the_page(runs, tmp_path):
    with closed_pipe():
        main(["compare", str(runs / "base"), str(runs / "tuck"), "--no-evaluate", "--out", str(tmp_path / "out")])
    assert {path.name for path in (tmp_path / "out").iterdir()} == {PICTURE, PAGE, DATA}
