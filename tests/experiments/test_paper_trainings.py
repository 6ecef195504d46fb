"""Arms of the trainings of the paper's tasks, their metric files and the table of results."""

import dataclasses
import json
from pathlib import Path

import pytest

from experiments import paper_trainings
from experiments.paper_trainings import GAP, NEVER, OFF, arm_flags, results_table
from jumper_warp.cli.train import parse_train
from jumper_warp.registry import make_task
from jumper_warp.utils.output import read_values, write_metrics

DOCS = Path(__file__).parents[2] / "docs"
JUMPS = ["vertical-jump-paper", "horizontal-jump-paper", "vertical-jump"]


def changed_task(name, arm):
    """Return the task that the flags of an arm make."""
    return parse_train([name, *arm_flags(make_task(name), arm)])[0].task


@pytest.mark.parametrize("name", JUMPS)
def test_arms_switch_off_initialisation_estimates_and_curriculum(name):
    task = make_task(name)
    assert changed_task(name, "full") == task
    modes = vars(changed_task(name, "no_initialisation").reset.settings.start_probability)
    assert {mode for mode, probability in modes.items() if probability} == {"default"}
    blind = changed_task(name, "no_estimates")
    assert {term.name for term, old in zip(blind.rewards, task.rewards, strict=True) if term != old} == {
        term.name for term in task.rewards if term.name.startswith("estimated") and term.weight
    }
    ends = [term for term, old in zip(blind.terminations, task.terminations, strict=True) if term != old]
    assert [term.numbers["tolerance"] for term in ends] == [OFF] * name.endswith("paper")
    assert set(changed_task(name, "no_curriculum").levels) == {task.levels[-1]}


def test_the_metric_file_names_the_primary_metrics_before_the_training(tmp_path, monkeypatch):
    def interrupted(arguments):
        raise KeyboardInterrupt

    monkeypatch.setattr(paper_trainings, "train_arm", interrupted)
    args = paper_trainings.Args(tasks=(JUMPS[0],), arms=("no_estimates",), seeds=(3,), out=tmp_path, device="cpu")
    with pytest.raises(KeyboardInterrupt):
        paper_trainings.main(args)
    written = json.loads((tmp_path / JUMPS[0] / "no_estimates_3" / "metrics.json").read_text())
    names = ["nominal_sweep_goal_reached_rate", "steps_to_50_percent"]
    assert written["conditions"]["primary"] == names
    assert [written["metrics"][name]["value"] for name in names] == [None, None]
    assert "--env.rewards.estimated-jump-height.weight 0" in written["conditions"]["flags"]


def test_finished_arms_are_skipped_and_the_table_names_gaps(tmp_path, monkeypatch):
    monkeypatch.setattr(paper_trainings, "train_arm", None)
    for seed, steps in ((0, 2.0e6), (1, 4.0e6)):
        folder = tmp_path / JUMPS[0] / f"full_{seed}"
        folder.mkdir(parents=True)
        values = {"nominal_sweep_goal_reached_rate": 0.8 + 0.1 * seed, "steps_to_50_percent": steps}
        write_metrics(folder, values | {"curve_steps": [1], "curve_values": [0.5]})
    other = tmp_path / JUMPS[0] / "no_estimates_0"
    other.mkdir()
    values = {"nominal_sweep_goal_reached_rate": 0.1, "steps_to_50_percent": None}
    write_metrics(other, values | {"curve_steps": [1], "curve_values": [0.1]})
    args = paper_trainings.Args(tasks=(JUMPS[0],), arms=("full",), seeds=(0, 1), out=tmp_path, device="cpu")
    assert paper_trainings.main(args) == {f"{JUMPS[0]}_full_0": 0.8, f"{JUMPS[0]}_full_1": pytest.approx(0.9)}
    rows = [line.split(" | ") for line in results_table(tmp_path).splitlines()[2:]]
    assert (tmp_path / "curves.webp").stat().st_size > 1000
    assert rows[0][3:5] == ["0.85 (0.8–0.9)", GAP]
    assert rows[4][3] == "3 (2–4)" and rows[4][5] == NEVER


def test_the_page_has_the_table_of_the_committed_metrics():
    page = DOCS / "results" / "paper.md"
    assert results_table(page.with_suffix("")) in page.read_text()


def test_an_interrupted_training_continues_and_is_tested(tmp_path):
    flags = "--num-envs 4 --max-iterations 1 --ppo.num-steps 8 --ppo.minibatches 1"
    args = paper_trainings.Args(tasks=(JUMPS[0],), arms=("no_curriculum",), seeds=(0,), num_jumps=2, save_interval=1,
                                train_flags=flags, out=tmp_path, device="cpu", threads=1)  # fmt: skip
    folder = tmp_path / JUMPS[0] / "no_curriculum_0"
    paper_trainings.train_arm(args.command(JUMPS[0], "no_curriculum", 0, folder / "runs"))
    longer = dataclasses.replace(args, train_flags=flags.replace("--max-iterations 1", "--max-iterations 2"))
    results = paper_trainings.main(longer)
    values = read_values(folder)
    assert values["curve_steps"] == [32, 64] and len(list((folder / "runs").rglob("config.json"))) == 1
    assert results == {f"{JUMPS[0]}_no_curriculum_0": values["nominal_sweep_goal_reached_rate"]}
    assert values["randomized_sweep_fall_rate"] is not None and "Episode_Termination/no_jump" in values
