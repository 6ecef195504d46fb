import sys
from collections import defaultdict

import newton
import numpy as np
import pytest
import warp as wp
from rerun.chunk import RrdReader

from jumper_warp.robot.model import build_model
from jumper_warp.viz.recorder import Recorder
from jumper_warp.viz.recording import Recording, RecordingError, load_npz
from jumper_warp.viz.rerun import write_rrd

HEIGHT = "base/height [m]"
TORQUE = "torque/FL_outer [N m]"
FRAMES = 5


@pytest.fixture(scope="module")
def model():
    """Two worlds with a red box and a free capsule each, on a ground plane."""
    one = newton.ModelBuilder()
    for name in ("body", "arm"):
        link = one.add_link(mass=1.0, inertia=wp.mat33(np.eye(3)), label=name)
        one.add_articulation([one.add_joint_free(link)])
        if name == "body":
            one.add_shape_box(link, hx=0.1, hy=0.2, hz=0.3, color=(1.0, 0.0, 0.0), label="box")
        else:
            one.add_shape_capsule(link, radius=0.1, half_height=0.2, label="rod")
    scene = newton.ModelBuilder()
    scene.replicate(one, 2, label_prefixes=["world_0", "world_1"])
    scene.add_ground_plane(label="ground")
    return scene.finalize(device="cpu")


def frame_poses(frame):
    """Return distinct poses of the four bodies, (4, 7), turned about z by 0.1 rad per frame and body."""
    angle = 0.05 * (frame + np.arange(4))
    poses = np.zeros((4, 7))
    poses[:, 0] = np.arange(4)
    poses[:, 2] = 0.1 * frame
    poses[:, 5], poses[:, 6] = np.sin(angle), np.cos(angle)
    return poses


def frame_contacts(frame, worlds):
    """Return points and forces of three contacts per world, (worlds, 3, 3) each."""
    points = np.arange(9.0 * worlds).reshape(worlds, 3, 3)
    return points, np.full((worlds, 3, 3), 100.0 * frame)


def record(model, worlds=(0,), **options):
    recorder = Recorder(model, worlds, **options)
    for frame in range(FRAMES):
        series = {HEIGHT: 0.1 * frame, TORQUE: -frame}
        recorder.record(0.02 * frame, frame_poses(frame), series, *frame_contacts(frame, len(worlds)))
    return recorder


def rows(path):
    """Return {entity: {component: [(time [s] or None, value), ...]}} of a Rerun file, read with Rerun's own reader."""
    found = defaultdict(lambda: defaultdict(list))
    for chunk in RrdReader(path).stream().to_chunks():
        batch = chunk.to_record_batch()
        data = {name: batch.column(name).to_pylist() for name in batch.schema.names}
        times = [None if chunk.is_static else time.total_seconds() for time in data.get("time", [None])]
        for name in set(data) - {"time", "rerun.controls.RowId"}:
            found[str(chunk.entity_path)][name] += zip(times, data[name], strict=True)
    return found


def test_recorder_keeps_the_chosen_world(model):
    recording = record(model, worlds=(1,)).recording()
    assert recording.bodies == ("world_1/body", "world_1/arm")
    assert recording.poses.shape == (FRAMES, 2, 7)
    assert recording.poses[3] == pytest.approx(frame_poses(3)[2:], abs=1e-6)
    assert {shape.name: shape.body for shape in recording.shapes} == {
        "box": 0,
        "rod": 1,
        "ground_light": -1,
        "ground_dark": -1,
    }


def test_frames_are_copies_of_the_state(model):
    state = model.state()
    recorder = Recorder(model)
    for frame in range(2):
        state.body_q.assign(frame_poses(frame).astype(np.float32))
        recorder.record(float(frame), state.body_q)
    assert recorder.recording().poses[:, 0, 2] == pytest.approx([0.0, 0.1])


@pytest.mark.parametrize("suffix", [".npz", ".anything"])
def test_npz_gives_back_everything(model, tmp_path, suffix):
    path = tmp_path / f"run{suffix}"
    written = record(model, worlds=(0, 1), spacing=1.5, notes={"seed": 3}).recording()
    assert written.save_npz(path) == path
    assert list(tmp_path.iterdir()) == [path]
    read = load_npz(path)
    assert (read.worlds, read.bodies, read.spacing, read.notes) == ((0, 1), written.bodies, 1.5, {"seed": 3})
    for name in ("times", "poses", "contact_points", "contact_forces"):
        np.testing.assert_array_equal(getattr(read, name), getattr(written, name))
    assert list(read.series) == [HEIGHT, TORQUE]
    np.testing.assert_array_equal(read.series[TORQUE], [0, -1, -2, -3, -4])
    assert [(shape.name, shape.body, shape.color) for shape in read.shapes] == [
        (shape.name, shape.body, shape.color) for shape in written.shapes
    ]
    for mine, theirs in zip(read.shapes, written.shapes, strict=True):
        np.testing.assert_array_equal(mine.vertices, theirs.vertices)
        np.testing.assert_array_equal(mine.triangles, theirs.triangles)


def test_npz_holds_no_pickles(model, tmp_path):
    record(model).save_npz(tmp_path / "run.npz")
    with np.load(tmp_path / "run.npz", allow_pickle=False) as archive:
        assert all(archive[name].dtype != object for name in archive.files)


def test_rrd_has_a_row_per_frame_and_the_poses_of_each(model, tmp_path):
    found = rows(record(model, worlds=(0, 1), spacing=1.5).save_rrd(tmp_path / "run.rrd"))
    for body, entity in enumerate(f"/scene/world_{w}/{link}" for w in (0, 1) for link in ("body", "arm")):
        moves = sorted(found[entity]["Transform3D:translation"])
        turns = sorted(found[entity]["Transform3D:quaternion"])
        assert [time for time, _ in moves] == pytest.approx([0.0, 0.02, 0.04, 0.06, 0.08])
        assert moves[3][1][0] == pytest.approx(frame_poses(3)[body, :3], abs=1e-6)
        assert turns[3][1][0] == pytest.approx(frame_poses(3)[body, 3:], abs=1e-6)
    # worlds are drawn apart by moving their parents
    assert found["/scene/world_1"]["Transform3D:translation"] == [(None, [[0.0, 1.5, 0.0]])]


def test_rrd_has_each_shape_once_below_its_body(model, tmp_path):
    found = rows(record(model).save_rrd(tmp_path / "run.rrd"))
    drawn = {entity for entity, components in found.items() if "Mesh3D:vertex_positions" in components}
    assert drawn == {
        "/scene/world_0/body/box",
        "/scene/world_0/arm/rod",
        "/scene/ground_light",
        "/scene/ground_dark",
    }
    ((time, corners),) = found["/scene/world_0/body/box"]["Mesh3D:vertex_positions"]
    assert time is None
    assert np.ptp(corners, axis=0) == pytest.approx([0.2, 0.4, 0.6])
    assert found["/scene/world_0/body/box"]["Mesh3D:albedo_factor"] == [(None, [0xFF0000FF])]


def test_robot_is_drawn_with_every_link(tmp_path):
    robot = build_model(1, device="cpu")
    recorder = Recorder(robot)
    recorder.record(0.0, robot.state().body_q)
    found = rows(recorder.save_rrd(tmp_path / "run.rrd"))
    links = ("housing", "outer_thigh", "outer_shank", "inner_thigh", "inner_shank")
    bodies = {f"{leg}_{link}" for leg in ("FL", "FR", "BL", "BR") for link in links} | {"body"}
    moving = {entity.split("/")[3] for entity, columns in found.items() if "Transform3D:quaternion" in columns}
    drawn = {
        entity.split("/")[3] for entity in found if entity.startswith("/scene/world_0/") and entity.count("/") == 4
    }
    assert moving == drawn == bodies


def test_rrd_has_the_series_and_forces(model, tmp_path):
    found = rows(record(model, worlds=(0, 1)).save_rrd(tmp_path / "run.rrd"))
    torque = sorted(found[r"/series/torque/FL_outer\ \[N\ m\]"]["Scalars:scalars"])
    assert [value for _, value in torque] == [[0.0], [-1.0], [-2.0], [-3.0], [-4.0]]
    assert r"/series/base/height\ \[m\]" in found
    arrows = found["/scene/world_1/contact_forces"]
    origins, vectors = sorted(arrows["Arrows3D:origins"]), sorted(arrows["Arrows3D:vectors"])
    assert len(vectors) == FRAMES
    assert origins[2][1] == [[9, 10, 11], [12, 13, 14], [15, 16, 17]]
    assert np.array(vectors[2][1]) == pytest.approx(np.full((3, 3), 0.2))  # 200 N at 1 mm/N


def test_rrd_carries_its_layout_and_a_saved_recording_can_be_drawn(model, tmp_path):
    record(model).save_npz(tmp_path / "run.npz")
    path = write_rrd(load_npz(tmp_path / "run.npz"), tmp_path / "run.rrd")
    reader = RrdReader(path)
    assert len(reader.recordings()) == len(reader.blueprints()) == 1
    views = [
        chunk.to_record_batch().column("ViewBlueprint:display_name").to_pylist()[0][0]
        for chunk in reader.stream(store=reader.blueprints()[0]).to_chunks()
        if "ViewBlueprint:display_name" in chunk.to_record_batch().schema.names
    ]
    assert sorted(views) == ["base", "scene", "torque"]
    assert sorted(item.name for item in tmp_path.iterdir()) == ["run.npz", "run.rrd"]


def test_rrd_without_rerun_fails_in_one_line_and_leaves_no_file(model, tmp_path, monkeypatch):
    recorder = record(model)
    monkeypatch.setitem(sys.modules, "rerun", None)
    with pytest.raises(ImportError, match="pip install rerun-sdk"):
        recorder.save_rrd(tmp_path / "run.rrd")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("content", [b"", b"not a zip", b"PK\x03\x04 truncated"])
def test_foreign_file_is_refused_by_name(tmp_path, content):
    path = tmp_path / "run.npz"
    path.write_bytes(content)
    with pytest.raises(RecordingError, match=r"run\.npz"):
        load_npz(path)


def test_truncated_missing_and_other_archives_are_refused(model, tmp_path):
    path = record(model).save_npz(tmp_path / "run.npz")
    path.write_bytes(path.read_bytes()[:-200])
    np.savez(tmp_path / "other.npz", a=np.zeros(3))
    for bad in (path, tmp_path / "absent.npz", tmp_path / "other.npz"):
        with pytest.raises(RecordingError, match=bad.name):
            load_npz(bad)


def test_damaged_archive_is_refused(model, tmp_path):
    whole = record(model).save_npz(tmp_path / "run.npz").read_bytes()
    for position in range(40, len(whole), len(whole) // 40):
        damaged = bytearray(whole)
        damaged[position] ^= 0xFF
        (tmp_path / "bad.npz").write_bytes(damaged)
        try:
            assert isinstance(load_npz(tmp_path / "bad.npz"), Recording)  # a byte that carries nothing
        except RecordingError:
            pass


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"time": 0.0}, "time must increase"),
        ({"time": float("nan")}, "time must increase"),
        ({"body_poses": np.zeros((3, 7))}, r"shape \(4, 7\)"),
        ({"series": {"base/height [m]": 1.0}}, "new or missing.*torque"),
        ({"contact_points": None}, "come together"),
        ({"contact_points": np.zeros((2, 3)), "contact_forces": np.zeros((2, 3))}, "every frame needs"),
        ({"contact_forces": np.zeros((4, 3))}, "contacts must have shape"),
    ],
)
def test_wrong_frame_is_refused_and_not_kept(model, change, message):
    frame = {"time": 1.0, "body_poses": frame_poses(0), "series": {HEIGHT: 0.0, TORQUE: 0.0}}
    frame |= {"contact_points": np.zeros((3, 3)), "contact_forces": np.zeros((3, 3))}
    recorder = Recorder(model)
    recorder.record(**frame)
    with pytest.raises(ValueError, match=message):
        recorder.record(**(frame | {"time": 2.0} | change))
    recorder.record(**(frame | {"time": 3.0}))
    recording = recorder.recording()
    assert len(recording.times) == len(recording.poses) == len(recording.series[HEIGHT]) == 2


@pytest.mark.parametrize("name", ["height [m]", "base/height", "base/height []", "a/b/c [m]", "/height [m]"])
def test_series_without_group_or_unit_is_refused(model, name):
    with pytest.raises(ValueError, match="group/quantity"):
        Recorder(model).record(0.0, frame_poses(0), {name: 1.0})


def test_absent_world_and_empty_recording_are_refused(model):
    with pytest.raises(ValueError, match="world 2 has no bodies"):
        Recorder(model, (0, 2))
    with pytest.raises(ValueError, match="nothing was recorded"):
        Recorder(model).recording()
