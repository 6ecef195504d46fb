"""Recordings: frames, NumPy archives and Rerun files, read back by Rerun's own reader."""

import json
from collections import defaultdict

import newton
import numpy as np
import pytest
import warp as wp
from rerun.chunk import RrdReader

from columns import X, Z
from jumper_warp.viz.recorder import Recorder
from jumper_warp.viz.recording import RecordingError, load_npz
from jumper_warp.viz.rerun import write_rrd

HEIGHT, TORQUE = "base/height [m]", "torque/FL_outer [N m]"  # series
FRAMES = 5  # of `record`, 0.02 s apart


@pytest.fixture(scope="module")
def model():
    """Return a model of two worlds, each with bodies `body` (a red box) and `arm` (a capsule), on a ground plane."""
    world = newton.ModelBuilder()
    body, arm = (world.add_link(mass=1.0, inertia=wp.mat33(np.eye(3)), label=name) for name in ("body", "arm"))
    for link in (body, arm):
        world.add_articulation([world.add_joint_free(link)])
    world.add_shape_box(body, hx=0.1, hy=0.2, hz=0.3, color=(1.0, 0.0, 0.0), label="box")
    world.add_shape_capsule(arm, radius=0.1, half_height=0.2, label="rod")
    scene = newton.ModelBuilder()
    scene.replicate(world, 2, label_prefixes=["world_0", "world_1"])
    scene.add_ground_plane(label="ground")
    return scene.finalize(device="cpu")


def frame_poses(frame):
    """Return distinct poses of the four bodies, (4, 7): [m], xyzw; turned about z by 0.1 rad by frame and body."""
    angle = 0.05 * (frame + np.arange(4))
    poses = np.zeros((4, 7))
    poses[:, X] = np.arange(4)  # [m]
    poses[:, Z] = 0.1 * frame
    poses[:, 5], poses[:, 6] = np.sin(angle), np.cos(angle)
    return poses


def frame_contacts(frame, worlds):
    """Return points [m] and forces [N] of three contacts by world, (worlds, 3, 3) each; all forces 100 N * frame."""
    points = np.arange(9.0 * worlds).reshape(worlds, 3, 3)
    return points, np.full((worlds, 3, 3), 100.0 * frame)


def record(model, worlds=(0,), **options):
    """Return a recorder with FRAMES frames of poses, contacts and series; options: of `Recorder`."""
    recorder = Recorder(model, worlds, **options)
    for frame in range(FRAMES):
        series = {HEIGHT: 0.1 * frame, TORQUE: -frame}
        recorder.record(0.02 * frame, frame_poses(frame), series, *frame_contacts(frame, len(worlds)))
    return recorder


def rows(path):
    """Return {entity: {component: [(time [s] or None if static, value), ...]}} of a Rerun file."""
    entities = defaultdict(lambda: defaultdict(list))
    for chunk in RrdReader(path).stream().to_chunks():
        batch = chunk.to_record_batch()
        data = {name: batch.column(name).to_pylist() for name in batch.schema.names}
        times = [None if chunk.is_static else time.total_seconds() for time in data.get("time", [None])]
        for name in set(data) - {"time", "rerun.controls.RowId"}:
            entities[str(chunk.entity_path)][name] += zip(times, data[name], strict=True)
    return entities


def test_recorder_keeps_bodies_and_shapes_of_the_chosen_world(model):
    recording = record(model, worlds=(1,)).recording()
    assert recording.bodies == ("world_1/body", "world_1/arm")
    assert recording.poses.shape == (FRAMES, 2, 7)
    assert recording.poses[3] == pytest.approx(frame_poses(3)[2:], abs=1e-6)  # bodies 2 and 3 of the model
    bodies = {"box": 0, "rod": 1, "ground_light": -1, "ground_dark": -1}
    assert {shape.name: shape.body for shape in recording.shapes} == bodies


@pytest.mark.parametrize("suffix", [".npz", ".anything"])
def test_npz_restores_the_recording(model, tmp_path, suffix):
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
    for shape, original in zip(read.shapes, written.shapes, strict=True):
        assert (shape.name, shape.body, shape.color) == (original.name, original.body, original.color)
        np.testing.assert_array_equal(shape.vertices, original.vertices)
        np.testing.assert_array_equal(shape.triangles, original.triangles)


@pytest.mark.parametrize(
    ("name", "damage"),
    [
        ("shape0_triangles", lambda values: values + 1000),
        ("shape0_vertices", lambda values: values * np.nan),
        ("shape0_normals", lambda values: values[:1]),
        ("header", lambda text: np.array(json.dumps(json.loads(str(text)) | {"states": {"a": ["x"]}}))),
    ],
)
def test_npz_with_other_shapes_or_states_is_refused(model, tmp_path, name, damage):
    path = record(model).recording().save_npz(tmp_path / "run.npz")
    archive = dict(np.load(path))
    assert damage(archive[name]) is not archive[name]
    np.savez(path, **archive | {name: damage(archive[name])})
    with pytest.raises(RecordingError, match=r"run\.npz: cannot be read as a recording"):
        load_npz(path)


def test_rrd_has_each_bodys_pose_in_each_frame(model, tmp_path):
    entities = rows(record(model, worlds=(0, 1), spacing=1.5).save_rrd(tmp_path / "run.rrd"))
    for body, entity in enumerate(f"/scene/world_{w}/{link}" for w in (0, 1) for link in ("body", "arm")):
        positions = sorted(entities[entity]["Transform3D:translation"])
        quaternions = sorted(entities[entity]["Transform3D:quaternion"])
        assert [time for time, _ in positions] == pytest.approx([0.0, 0.02, 0.04, 0.06, 0.08])
        assert positions[3][1][0] == pytest.approx(frame_poses(3)[body, :3], abs=1e-6)
        assert quaternions[3][1][0] == pytest.approx(frame_poses(3)[body, 3:], abs=1e-6)
    # worlds are drawn apart by moving their parent entities
    assert entities["/scene/world_1"]["Transform3D:translation"] == [(None, [[0.0, 1.5, 0.0]])]


def test_rrd_has_the_series_and_forces(model, tmp_path):
    entities = rows(record(model, worlds=(0, 1)).save_rrd(tmp_path / "run.rrd"))
    torque = sorted(entities[r"/series/torque/outer\ \[N\ m\]"]["Scalars:scalars"])
    assert [value for _, value in torque] == [[0.0], [-1.0], [-2.0], [-3.0], [-4.0]]
    assert r"/series/base/height\ \[m\]" in entities
    arrows = entities["/scene/world_1/contact_forces"]
    origins, vectors = sorted(arrows["Arrows3D:origins"]), sorted(arrows["Arrows3D:vectors"])
    assert len(vectors) == FRAMES
    assert origins[2][1] == [[9, 10, 11], [12, 13, 14], [15, 16, 17]]  # [m] of world 1
    assert np.array(vectors[2][1]) == pytest.approx(np.full((3, 3), 0.2))  # 200 N at 1 mm/N


def test_rrd_has_goals_trails_and_the_changes_of_states(model, tmp_path):
    recorder = Recorder(model, spacing=1.5)
    for frame in range(FRAMES):
        points = np.zeros((1, 4, 3)) + np.arange(4)[:, None] + (0.01 * frame, 0.0, 0.0)
        phase = {"phase/0.90 m": "stance" if frame < 3 else "flight"}
        recorder.record(0.02 * frame, frame_poses(frame), {}, points, np.zeros_like(points), states=phase)
    goals, heights = np.array([[[0.8, 0.2, 0.0]]]), np.array([0.9])
    entities = rows(write_rrd(recorder.recording(goals=goals, heights=heights), tmp_path / "run.rrd"))
    ring = np.array(entities["/scene/goal_0_0"]["Mesh3D:vertex_positions"][0][1])
    assert ring.mean(axis=0)[:2] == pytest.approx([0.8, 0.2], abs=1e-4)
    assert "/scene/height_0" in entities
    ((time, (base, *paws)),) = entities["/scene/world_0/trail"]["LineStrips3D:strips"]
    assert time is None and len(paws) == 4
    assert np.array(base) == pytest.approx(np.array([frame_poses(frame)[0, :3] for frame in range(FRAMES)]))
    assert np.array(paws[2]) == pytest.approx(np.array([[2.0 + 0.01 * frame, 2.0, 2.0] for frame in range(FRAMES)]))
    changes = sorted(entities[r"/states/phase/0.90\ m"]["StateChange:state"])
    assert changes == [(pytest.approx(0.0), ["stance"]), (pytest.approx(0.06), ["flight"])]


def test_rrd_has_commanded_and_actual_velocity_of_a_turned_base(model, tmp_path):
    recorder = Recorder(model)
    for frame in range(FRAMES):
        poses = np.zeros((4, 7))
        poses[0] = [0.1 * frame, -0.04 * frame, 0.3, 0.0, 0.0, np.sqrt(0.5), np.sqrt(0.5)]  # 90° to the left
        recorder.record(0.1 * frame, poses, commands=np.array([[0.6, 0.2, 0.1]]))
    entities = rows(recorder.save_rrd(tmp_path / "run.rrd"))
    for name, velocity in (("commanded", [-0.2, 0.6, 0.0]), ("actual", [1.0, -0.4, 0.0])):  # [m/s]
        arrows = [value for _, value in entities[f"/scene/world_0/{name}_velocity"]["Arrows3D:vectors"]]
        assert np.array(arrows) == pytest.approx(np.tile(0.5 * np.array(velocity), (FRAMES, 1, 1)), abs=1e-5)
