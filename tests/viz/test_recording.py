"""Recordings: frames, NumPy archives and Rerun files, read back by Rerun's own reader."""

from collections import defaultdict

import newton
import numpy as np
import pytest
import warp as wp
from rerun.chunk import RrdReader

from columns import X, Z
from jumper_warp.robot.model import build_model
from jumper_warp.viz.recorder import Recorder
from jumper_warp.viz.recording import RecordingError, load_npz
from jumper_warp.viz.rerun import write_rrd
from jumper_warp.viz.style import LEG_COLORS

HEIGHT, TORQUE = "base/height [m]", "torque/FL_outer [N m]"  # series
FRAMES = 5  # of `record`, 0.02 s apart
REVERSED = ("BR", "BL", "FR", "FL")
LEGS = [LEG_COLORS[leg] for leg in reversed(REVERSED)]


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


def test_frames_are_copies_of_the_state(model):
    state = model.state()
    recorder = Recorder(model)
    for frame in range(2):
        state.body_q.assign(frame_poses(frame).astype(np.float32))
        recorder.record(float(frame), state.body_q)
    assert recorder.recording().poses[:, 0, 2] == pytest.approx([0.0, 0.1])


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


def test_rrd_has_each_shape_once_below_its_body(model, tmp_path):
    entities = rows(record(model).save_rrd(tmp_path / "run.rrd"))
    drawn = {entity for entity, components in entities.items() if "Mesh3D:vertex_positions" in components}
    scene = ("world_0/body/box", "world_0/arm/rod", "ground_light", "ground_dark", "view_target")
    assert drawn == {f"/scene/{shape}" for shape in scene}
    box = entities["/scene/world_0/body/box"]
    ((time, corners),) = box["Mesh3D:vertex_positions"]
    assert time is None
    assert np.ptp(corners, axis=0) == pytest.approx([0.2, 0.4, 0.6])  # [m]
    assert box["Mesh3D:albedo_factor"] == [(None, [0xFF0000FF])]  # red, opaque


def test_rrd_draws_and_moves_every_link_of_the_robot(tmp_path):
    robot = build_model(1, device="cpu")
    recorder = Recorder(robot)
    recorder.record(0.0, robot.state().body_q)
    entities = rows(recorder.save_rrd(tmp_path / "run.rrd"))
    links = ("housing", "outer_thigh", "outer_shank", "inner_thigh", "inner_shank")
    bodies = {f"{leg}_{link}" for leg in ("FL", "FR", "BL", "BR") for link in links} | {"body"}
    moving = {entity.split("/")[3] for entity, columns in entities.items() if "Transform3D:quaternion" in columns}
    parts = [entity.split("/") for entity in entities if entity.startswith("/scene/world_0/")]
    assert moving == {part[3] for part in parts if len(part) == 5} == bodies  # "", scene, world, link, shape


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


def blueprint(path):
    """Return {component: [value, ...]} of all entities of a Rerun file's blueprint."""
    reader, values = RrdReader(path), defaultdict(list)
    for chunk in reader.stream(store=reader.blueprints()[0]).to_chunks():
        batch = chunk.to_record_batch()
        for name in (name for name in batch.schema.names if ":" in name):  # components, without times
            values[name] += batch.column(name).to_pylist()
    return values


def test_rrd_plays_from_the_start_and_its_eye_follows_the_worlds(model, tmp_path):
    path = record(model, worlds=(0, 1), spacing=1.5).save_rrd(tmp_path / "run.rrd")
    layout, target = blueprint(path), rows(path)["/scene/view_target"]  # the entity that the eye looks at and follows
    assert layout["TimePanelBlueprint:play_state"] == [[2]]  # playing; 3 would follow the end
    assert layout["EyeControls3D:tracking_entity"] == [["/scene/view_target"]]
    positions = [value[0] for _, value in sorted(target["Transform3D:translation"])]
    # mean of the bodies at x = 0 and 2 m; heights of 0 to 0.4 m; the second world is drawn 1.5 m to the left
    assert np.array(positions) == pytest.approx(np.tile([1.0, 0.75, 0.2], (FRAMES, 1)))
    eye, center = np.array(layout["EyeControls3D:position"]), np.array(layout["EyeControls3D:look_target"])
    assert center[0, 0] == pytest.approx(positions[0])
    ends = np.array(target["Mesh3D:vertex_positions"][0][1])  # the viewer's distance is 1.5 times their radius
    assert np.linalg.norm(eye - center) == pytest.approx(0.75 * np.linalg.norm(ends[1] - ends[0]), rel=1e-3)


def test_rrd_shows_a_curve_of_each_leg_in_the_order_and_colors_of_legs(model, tmp_path):
    recorder = Recorder(model)
    for frame in range(2):
        recorder.record(frame, frame_poses(frame), {f"torque/{leg}_inner [N m]": i for i, leg in enumerate(REVERSED)})
    entities = rows(recorder.save_rrd(tmp_path / "run.rrd"))
    inner = entities[r"/series/torque/inner\ \[N\ m\]"]
    assert inner["SeriesLines:names"] == [(None, ["FL", "FR", "BL", "BR"])]
    assert [value for _, value in inner["Scalars:scalars"]] == [[3.0, 2.0, 1.0, 0.0]] * 2
    colors = [sum(round(255 * c) << shift for c, shift in zip(rgb, (24, 16, 8), strict=True)) + 255 for rgb in LEGS]
    assert inner["SeriesLines:colors"] == [(None, colors)] and len(set(colors)) == 4


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


def test_load_npz_refuses_truncated_missing_and_other_archives_by_name(model, tmp_path):
    path = record(model).save_npz(tmp_path / "run.npz")
    path.write_bytes(path.read_bytes()[:-200])
    np.savez(tmp_path / "other.npz", a=np.zeros(3))
    for bad in (path, tmp_path / "absent.npz", tmp_path / "other.npz"):
        with pytest.raises(RecordingError, match=bad.name):
            load_npz(bad)
