"""The demonstration of `make demo` at a tiny size."""

import pytest

from experiments import demo
from metric_helpers import saved_metrics


@pytest.mark.usefixtures("one_thread")
def test_demo_prints_one_summary_of_all_parts_and_writes_a_film(tmp_path, capsys):
    values = demo.main(demo.Args(num_jumps=3, size=(96, 64), out=tmp_path, device="cpu"))
    lines, saved = capsys.readouterr().out.splitlines(), saved_metrics(tmp_path)
    assert len(lines) <= 24 and max(len(line.replace(str(tmp_path), "outputs/demo")) for line in lines) <= 80
    assert set(saved) == set(values) and all(saved[key].value is not None for key in demo.SUMMARY)
    vertical = saved_metrics(tmp_path / "vertical_jump")
    assert saved["vertical_goal_reached_rate"] == vertical["goal_reached_rate"]
    assert saved["open_loop_apex_height_m"].value == pytest.approx(1.075, abs=0.01)
    assert saved["filmed_goal_distance_at_rest_m"].value < 0.1
    for name in ("jump.mp4", "jump.png", "jump.rrd", "open_loop/jump.rrd", "horizontal_jump/sweep.png"):
        assert (tmp_path / name).stat().st_size > 1000, name
