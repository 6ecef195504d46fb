"""Experiment of walking and jumping with the shipped policies at a tiny size."""

import pytest

from experiments import walk_jump_walk
from jumper_warp.utils.output import read_values

pytestmark = pytest.mark.usefixtures("one_thread")
KEYS = (
    "finished_rate", "settled_slewed_rmse_vx_m_s", "settled_slewed_rmse_yaw_rate_rad_s", "apex_error_abs_mean_m",
    "goal_distance_at_handover_mean_m", "command_to_takeoff_mean_s",
)  # fmt: skip


def test_walk_jump_walk_with_two_robots_succeeds(tmp_path, monkeypatch):
    monkeypatch.setattr(walk_jump_walk, "WALKS", (1, 1, 1))
    monkeypatch.setattr(walk_jump_walk, "EACH", 1.5)
    values = walk_jump_walk.main(walk_jump_walk.Args(num_robots=2, num_recorded=1, out=tmp_path, device="cpu"))
    metrics = read_values(tmp_path)
    assert metrics == values and set(KEYS) <= set(metrics)
    assert metrics["finished_rate"] == metrics["jump_made_rate"] == 1.0
    assert metrics["apex_error_abs_mean_m"] < 0.05 and metrics["goal_distance_at_handover_mean_m"] < 0.05
    assert 0.0 < metrics["settled_slewed_rmse_vx_m_s"] < 0.2 and 0.2 < metrics["command_to_takeoff_mean_s"] < 2.5
    assert (tmp_path / "timeline.png").is_file() and (tmp_path / "walk_jump_walk.rrd").stat().st_size > 10_000
