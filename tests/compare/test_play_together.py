import numpy as np
import pytest

from closed_pipe import closed_pipe
from jumper_warp.cli.main import main
from jumper_warp.compare.motions import compare_motions
from jumper_warp.registry import make_task
from recordings import record_jumps

MOTIONS = (("low", 0.5, 18), ("high", 0.9, 30))  # name, commanded height [m], policy steps


@pytest.fixture(scope="module")
def motions():
    return {name: record_jumps([height], steps, [0]).recording() for name, height, steps in MOTIONS}


def test_motions_begin_together_and_the_shorter_one_ends_in_its_last_pose(motions):
    together = compare_motions(motions, make_task("vertical-jump"))
    low, high = motions.values()
    assert len(together.times) == len(high.times) == 30
    np.testing.assert_array_equal(together.body_poses(0)[:18], low.poses)
    np.testing.assert_array_equal(together.body_poses(0)[18:], np.broadcast_to(low.poses[-1], (12, 21, 7)))
    np.testing.assert_array_equal(together.body_poses(1), high.poses)
    np.testing.assert_allclose(together.heights, [0.5, 0.9])
    assert together.labels == ("low", "high")


def test_a_plot_has_one_reward_term_of_all_motions_and_the_sum_comes_first(motions):
    series = compare_motions(motions, make_task("vertical-jump")).series
    groups = list(dict.fromkeys(name.partition("/")[0] for name in series))
    assert groups[:2] == ["height", "reward, sum of all rewards so far"]
    for group in groups:
        labels = {name.rpartition(", ")[2].partition(" [")[0] for name in series if name.startswith(f"{group}/")}
        assert labels == {"low", "high"}
    total = sum(series[name] for name in series if name.startswith("reward, ") and ", high [" in name)
    so_far = series["reward, sum of all rewards so far/total, high [1]"]
    np.testing.assert_allclose(total.sum() - so_far.sum(), so_far[-1], rtol=1e-5)


def test_play_writes_film_picture_and_recording_although_its_reader_closes_the_pipe(motions, tmp_path):
    for name, recording in motions.items():
        recording.save_npz(tmp_path / f"{name}.npz")
    film = ["--video", str(tmp_path / "film.gif"), "--out", str(tmp_path / "out")]
    with closed_pipe():
        main(["play", f"first={tmp_path}/low.rrd", f"{tmp_path}/high.rrd", *film])
    assert {path.name for path in (tmp_path / "out").iterdir()} == {"motions.png", "motions.rrd"}
    assert (tmp_path / "film.gif").exists()
