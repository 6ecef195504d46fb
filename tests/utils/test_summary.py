import numpy as np

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


def test_summary_has_main_metrics_in_words_with_units_beside_the_papers_values(tmp_path, capsys):
    report = write_metrics(tmp_path, METRICS, {"solver": "jumper"})
    print_summary(report, "200 jumps", tuple(METRICS)[:5], paper=PAPER, flags=PrintFlags(), seconds=12.3)
    lines = [line.split() for line in capsys.readouterr().out.splitlines()]
    assert lines[:2] == [["200", "jumps"], ["value", "95", "%", "interval", "paper"]]
    assert lines[2][:5] == ["goal", "reached", "rate", "96.5", "%"] and lines[2][-1] == "91"
    assert lines[3] == "goal reached rate, 0.5 to 1.1 m 100 %".split()
    assert lines[4][:7] == "apex error, mean size 0.02 m".split() + ["0.01"] and lines[4][-1] == "0.04"
    assert lines[5] == ["apex,", "max", "undefined"]
    assert lines[6] == ["steps", "12,346", "1/s"]
