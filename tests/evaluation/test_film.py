import numpy as np
import pytest

from jumper_warp.evaluation.film import ankles, keyframes
from jumper_warp.viz.props import MARK_LIFT, MARK_RADIUS, with_blocks, with_goal_markers
from jumper_warp.viz.recording import Recording


def recording(frames=3, worlds=2, spacing=2.0):
    """Return a recording with one body per world at the origin; spacing [m]: between worlds along y."""
    return Recording(
        times=np.arange(1, frames + 1) / 60.0,
        worlds=tuple(range(worlds)),
        bodies=tuple(f"world_{world}/body" for world in range(worlds)),
        poses=np.zeros((frames, worlds, 7), dtype=np.float32),
        series={},
        contact_points=np.zeros((frames, worlds, 0, 3), dtype=np.float32),
        contact_forces=np.zeros((frames, worlds, 0, 3), dtype=np.float32),
        spacing=spacing,
    )


def test_ankle_positions_follow_shank_poses():
    poses = np.zeros((1, 21, 7))
    poses[..., 6] = 1.0
    poses[0, 5, 2] = 1.0  # [m] FL shank is link 5, FR shank link 10; the ankle is 0.3 m below the shank's origin
    poses[0, 10] = [0.0, 0.0, 1.0, 0.0, np.sqrt(0.5), 0.0, np.sqrt(0.5)]  # 90° about y: z points to x
    points = ankles(poses)
    assert points.shape == (1, 4, 3)
    assert points[0, 0] == pytest.approx([0.0, 0.0, 0.7])
    assert points[0, 1] == pytest.approx([-0.3, 0.0, 1.0])


def test_keyframes_are_command_squat_push_apex_fall_catch_end():
    height = np.array([0.35, 0.35, 0.30, 0.20, 0.40, 0.70, 0.90, 0.70, 0.40, 0.25, 0.30, 0.35])
    assert keyframes(height, command=1) == [1, 3, 5, 6, 7, 9, 11]


@pytest.mark.parametrize(("command", "first"), [(-1, 0), (99, 2)])
def test_keyframes_clamp_command_to_recording(command, first):
    assert keyframes(np.array([0.3, 0.4, 0.3]), command)[0] == first


def test_goal_markers_are_fixed_discs_that_skip_nan_and_are_spaced_by_world():
    places = np.array([[[0.8, 0.2, 0.0], [np.nan, np.nan, 0.0]], [[0.5, 0.0, 0.1], [0.6, 0.0, 0.1]]])
    shapes = with_goal_markers(recording(), places).shapes
    assert [shape.name for shape in shapes] == ["goal_0_0", "goal_1_0", "goal_1_1"]
    assert all(shape.body == -1 for shape in shapes)
    assert shapes[0].vertices[0] == pytest.approx([0.8, 0.2, MARK_LIFT])
    assert shapes[2].vertices[0] == pytest.approx([0.6, 2.0, 0.1 + MARK_LIFT])
    rim = shapes[2].vertices[1:] - shapes[2].vertices[0]
    assert np.linalg.norm(rim, axis=1) == pytest.approx(MARK_RADIUS, rel=1e-5)
    assert shapes[0].triangles.max() == len(shapes[0].vertices) - 1


def test_blocks_are_bodies_that_move():
    centers = np.array([[[0.8, 0.0], [1.0, 0.1]], [[0.81, 0.0], [1.0, 0.1]], [[0.82, 0.0], [1.1, 0.1]]])
    shown = with_blocks(recording(), centers, np.array([[0.4, 0.3], [0.4, 0.3]]), np.array([0.05, 0.1]))
    assert shown.bodies == ("world_0/body", "world_1/body", "world_0/block", "world_1/block")
    assert shown.poses[2, 2] == pytest.approx([0.82, 0.0, 0.025, 0.0, 0.0, 0.0, 1.0])
    assert shown.poses[2, 3] == pytest.approx([1.1, 0.1, 0.05, 0.0, 0.0, 0.0, 1.0])
    assert [shape.body for shape in shown.shapes] == [2, 3]
    assert np.ptp(shown.shapes[1].vertices, axis=0) == pytest.approx([0.8, 0.6, 0.1])
