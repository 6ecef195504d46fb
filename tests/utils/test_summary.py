import json

import numpy as np
import pytest

from jumper_warp.utils.metrics import MetricValue, mean, rate
from jumper_warp.utils.output import write_metrics
from jumper_warp.utils.summary import PrintFlags, print_summary

METRICS = {
    "goal_reached_rate": rate(np.arange(200) >= 7, "jumps"),
    "in_range_goal_reached_rate": MetricValue(1.0, 171, None, "jumps with goals of 0.5 to 1.1 m"),
    "apex_error_abs_mean_m": mean(np.array([0.01, 0.02, 0.03]), "jumps"),
    "apex_max_m": MetricValue(None, 0, None, "jumps"),
    "steps_per_s": 12345.6,
    "bin_m": [1.0, 1.5],
}
PAPER = {"goal_reached_rate": 0.91, "apex_error_abs_mean_m": 0.04}


@pytest.fixture
def summary(tmp_path, capsys):
    """Function that prints the summary of METRICS in a folder with some files, and returns its text and the folder."""

    # keys: metrics to print; files: empty files in the folder; flags: of `PrintFlags`
    def run(keys=tuple(METRICS)[:5], files=("a.png", "film.mp4", "jump.rrd", "notes.txt"), **flags):
        report = write_metrics(tmp_path, METRICS, {"solver": "jumper"})
        for name in files:
            (tmp_path / name).touch()
        print_summary(report, "200 jumps", keys, paper=PAPER, flags=PrintFlags(**flags), seconds=12.3)
        return capsys.readouterr().out, tmp_path

    return run


def test_summary_has_main_metrics_in_words_with_units_beside_the_papers_values(summary):
    lines = [line.split() for line in summary()[0].splitlines()]
    assert lines[:2] == [["200", "jumps"], ["value", "95", "%", "interval", "paper"]]
    assert lines[2][:5] == ["goal", "reached", "rate", "96.5", "%"] and lines[2][-1] == "91"
    assert lines[3] == "goal reached rate, 0.5 to 1.1 m 100 %".split()
    assert lines[4][:7] == "apex error, mean size 0.02 m".split() + ["0.01"] and lines[4][-1] == "0.04"
    assert lines[5] == ["apex,", "max", "undefined"]
    assert lines[6] == ["steps", "12,346", "1/s"]


def test_summary_names_ranges_and_ends_in_words(tmp_path, capsys):
    keys = {
        "within_training_success_rate": MetricValue(0.5, 2, None, "jumps with goals of trained 0.4 to 1.1 m"),
        "beyond_training_success_rate": MetricValue(0.5, 2, None, "jumps beyond training"),
        "ended_by_low_base_rate": MetricValue(0.1, 2, None, "episodes"),
        "ended_by_no_end_rate": MetricValue(0.9, 2, None, "episodes"),
        "end": "no_end",
    }
    print_summary(write_metrics(tmp_path, keys), "2 jumps", keys, seconds=1.0)
    lines = [" ".join(line.split()) for line in capsys.readouterr().out.splitlines()]
    assert lines[2:7] == [
        "success rate, trained 0.4 to 1.1 m 50 %",
        "success rate, beyond training 50 %",
        "ended by low base 10 %",
        "ended by time limit 90 %",
        "end time limit",
    ]


def test_summary_lists_picture_film_recording_and_metrics_but_no_other_files(summary):
    text, folder = summary()
    for kind, name in (
        ("picture", "a.png"),
        ("film", "film.mp4"),
        ("recording", "jump.rrd"),
        ("metrics", "metrics.json"),
    ):
        assert f"{kind:9}  {folder / name}\n" in text
    assert "notes.txt" not in text and "--verbose prints 6 metrics" in text
    assert text.count("\n") <= 24


def test_summary_counts_files_of_a_kind_if_there_are_many(summary):
    text, folder = summary(files=[f"{i}.png" for i in range(4)])
    assert f"pictures   4 in {folder}\n" in text and "0.png" not in text and "rerun" not in text


def test_summary_of_lists_has_a_column_for_each_trial(tmp_path, capsys):
    report = write_metrics(tmp_path, {"apex_m": [0.5, None], "outcome": ["success", "tilted"]})
    film = tmp_path / "films" / "jump.webp"
    print_summary(report, "2 jumps", ["apex_m", "outcome"], seconds=1.0, trial="jump", films=[film])
    lines = [line.split() for line in capsys.readouterr().out.splitlines()]
    assert lines[1:4] == ["jump 1 jump 2".split(), "apex 0.5 m undefined".split(), "outcome success tilted".split()]
    assert ["film", str(film)] in lines and not any("picture" in line for line in lines)


def test_verbose_prints_conditions_and_all_metrics_by_key(summary):
    text, _ = summary(keys=(), verbose=True)
    assert "solver jumper" in text and all(key in text for key in METRICS) and "--verbose" not in text


def test_json_prints_the_file_and_nothing_else(summary):
    text, folder = summary(json=True)
    assert json.loads(text) == json.loads((folder / "metrics.json").read_text())
