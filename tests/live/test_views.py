"""Views of watched worlds: what the Rerun viewer and a page in the browser receive, and a whole `--watch`."""

import time
from collections import defaultdict

import numpy as np
import pytest
import rerun as rr
from rerun.chunk import RrdReader

from jumper_warp.live.checkpoints import watch_checkpoints
from jumper_warp.live.clips import ROLES
from jumper_warp.live.curves import MetricsTail
from jumper_warp.live.feed import live_address
from jumper_warp.live.rerun_view import RerunView
from jumper_warp.live.scene import robot_scene
from jumper_warp.live.training import TrainingWatch
from jumper_warp.sim.simulation import Simulation
from jumper_warp.training import train
from jumper_warp.utils.errors import InputError
from live_helpers import short_training

TERMS = ("near_goal", "action_rate")


@pytest.fixture(scope="module")
def sim():
    """Return a simulation of four standing robots."""
    return Simulation(len(ROLES), device="cpu")


def rows(path):
    """Return the values of each entity in a Rerun file, {entity: {component: [value, ...]}}."""
    entities = defaultdict(lambda: defaultdict(list))
    for chunk in RrdReader(path).stream().to_chunks():
        batch = chunk.to_record_batch()
        for name in batch.schema.names:
            if name == "time":
                entities[str(chunk.entity_path)][name] += [time.value / 1e9 for time in batch.column(name)]
            elif not name.startswith(("rerun", "log_t")):
                entities[str(chunk.entity_path)][name] += batch.column(name).to_pylist()
    return entities


def fill(view, sim):
    """Show three frames, rewards and curves in a view."""
    poses = np.stack(3 * [sim.links()[0]])
    goals = np.array([[1.0, 0.0, 0.0], *(3 * [[np.nan] * 3])])
    view.show(np.array([10.0, 10.1, 10.2]), poses, goals)
    view.show_rewards(10.2, np.array([[2.0, -1.0], [1.0, -0.5], [0.5, 0.0], [4.0, -2.0]]))
    lines = [{"iteration": i, "Perf/elapsed_s": 1.0 * i, "Metrics/success": 0.1 * i, "Loss/kl": None} for i in (1, 2)]
    view.show_curves(lines)
    view.show_status("**run**")
    return poses


def test_rerun_receives_robots_rewards_and_curves(sim, tmp_path):
    stream = rr.RecordingStream("jumper-warp test")
    memory = stream.memory_recording()
    view = RerunView(stream, robot_scene(sim.model), ROLES, TERMS)
    poses = fill(view, sim)
    (tmp_path / "live.rrd").write_bytes(memory.drain_as_bytes())
    shown = rows(tmp_path / "live.rrd")
    body = shown["/scene/body"]
    assert body["time"] == pytest.approx([10.0, 10.1, 10.2])
    np.testing.assert_allclose(body["InstancePoses3D:translations"][2], poses[2, :, 0, :3], rtol=1e-6)
    assert len(shown["/scene/FL_outer_shank"]["InstancePoses3D:quaternions"][0]) == len(ROLES)
    assert len(shown["/scene/FL_outer_shank"]["Mesh3D:vertex_positions"]) == 1
    assert len(shown["/scene/goals"]["LineStrips3D:strips"][0]) == 1
    boxes = np.array(shown["/rewards/terms"]["Boxes2D:centers"][0]).reshape(4, 2, 2)
    np.testing.assert_allclose(boxes[3, :, 1], [-0.5, 0.25])  # up is negative; 4.0 is the largest bar
    half = np.array(shown["/rewards/terms"]["Boxes2D:half_sizes"][0]).reshape(4, 2, 2)
    np.testing.assert_allclose(half[0, :, 1], [0.25, 0.125])
    assert shown["/curves/metrics/success"]["time"] == [1.0, 2.0]
    assert shown["/curves/metrics/success"]["Scalars:scalars"] == [[0.1], [0.2]]
    assert not any("kl" in entity for entity in shown)


class WaitingWatch(TrainingWatch):
    """Watch that waits for the viewer's address after the second iteration."""

    def after_iteration(self, runs):
        super().after_iteration(runs)
        if runs[0].iteration == 2:
            end = time.monotonic() + 120.0
            while (address := live_address(runs[0].folder.parent)) is None and time.monotonic() < end:
                time.sleep(0.1)
            self.address = address


def test_a_watched_training_can_be_joined_while_it_runs_and_leaves_no_server(tmp_path):
    watch = WaitingWatch()
    result = train(short_training(tmp_path), observers=[watch])
    url, page = watch.address
    assert url.startswith("rerun+http://127.0.0.1:") and page.startswith("http://127.0.0.1:")
    assert watch.feed.process.wait(60) == 0
    assert live_address(result.folder) is None


def test_watch_simulates_the_newest_checkpoint(tmp_path, capsys):
    result = train(short_training(tmp_path))
    watch_checkpoints(result.folder, "cpu", seconds=0.5, viewer="none")
    assert "iteration_000004.pt" in capsys.readouterr().err


def test_watch_fails_with_the_process_of_its_viewer(tmp_path, monkeypatch):
    folder = train(short_training(tmp_path)).folder
    monkeypatch.setenv("PYTHONHOME", str(tmp_path))  # in which no Python starts
    with pytest.raises(InputError, match="the viewer's process ended with status 1"):
        watch_checkpoints(folder, "cpu", viewer="viser")


def test_tail_reads_complete_lines_once(tmp_path):
    tail = MetricsTail(tmp_path)
    assert tail.lines() == []
    (tmp_path / "metrics.jsonl").write_text('{"iteration": 1}\n{"iter')
    assert tail.lines() == [{"iteration": 1}]
    with (tmp_path / "metrics.jsonl").open("a") as file:
        file.write('ation": 2}\nnull\n{"it\n')
    assert tail.lines() == [{"iteration": 2}]
