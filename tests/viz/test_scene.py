"""Framing, following, velocity arrows and labels, against an independent pinhole camera and hand-made motions."""

import math

import numpy as np
import pytest

from box_robot import RATE, STANDING, box_recording, pinhole, walk
from jumper_warp.viz.props import with_blocks
from jumper_warp.viz.renderer import View
from jumper_warp.viz.scene import (
    ARROW_SECONDS,
    DEAD_ZONE,
    MARGIN,
    Label,
    annotate,
    body_paths,
    corners,
    fit,
    follow,
    valid_frames,
    velocity_arrows,
)
from jumper_warp.viz.style import ACTUAL_COLOR, COMMAND_COLOR

SIZE = (200, 120)  # [px]


def out_of_view(points, view, eye):
    """Return the largest distance of a point from the image's middle over that of the margin, from an eye [m]."""
    pixels = pinhole(points, eye, view.target, view.field_of_view, SIZE)
    return float((np.abs(pixels / SIZE - 0.5) / (0.5 * MARGIN)).max())


@pytest.mark.parametrize("direction", [(0.6, -1.0, 0.3), (-1.0, 0.2, 0.8), (0.0, 1.0, 0.0)])
@pytest.mark.parametrize("extent", [(3.0, 0.4, 0.5), (0.3, 0.3, 2.0), (5.0, 5.0, 0.1)])
def test_fitted_view_shows_all_points_and_no_nearer_view_does(direction, extent):
    points = np.random.default_rng(3).uniform(-0.5, 0.5, (40, 3)) * extent + [4.0, -2.0, 1.0]
    view = fit(points, np.array(direction), SIZE, 25.0)
    ahead = view.target - view.eye
    assert (
        np.cross(ahead, direction) == pytest.approx(0.0, abs=1e-6 * np.linalg.norm(ahead)) and ahead @ direction < 0.0
    )
    assert out_of_view(points, view, view.eye) <= 1.0 + 1e-6
    assert out_of_view(points, view, view.eye + 0.03 * ahead) > 1.0


def test_fitted_points_are_in_the_middle_of_the_image():
    points = np.array([[x, y, z] for x in (0.0, 3.0) for y in (0.0, 6.0) for z in (0.0, 0.5)])
    view = fit(points, np.array([0.6, -1.0, 0.3]), SIZE)
    pixels = pinhole(points, view.eye, view.target, view.field_of_view, SIZE)
    assert 0.5 * (pixels.min(axis=0) + pixels.max(axis=0)) == pytest.approx([100.0, 60.0], abs=2.0)


def test_boxes_around_robots_end_at_the_ground():
    bases = np.array([[0.0, 0.0, 0.3], [2.0, 1.0, 0.9]])
    around = corners(bases, ground=0.0)
    assert around.min(axis=0) == pytest.approx([-0.45, -0.45, 0.0]) and around.max(axis=0) == pytest.approx(
        [2.45, 1.45, 1.15]
    )


def test_camera_rests_while_the_robot_moves_within_the_dead_zone():
    angle = np.linspace(0.0, 12.0, 120)
    circle = np.stack([0.2 * np.cos(angle), 0.2 * np.sin(angle), 0.3 + 0.15 * np.sin(2.0 * angle)], axis=1)
    circle[0] = [0.0, 0.0, 0.3]
    assert follow(circle[:, None], 1.0 / RATE) == pytest.approx(np.tile([0.0, 0.0, 0.3], (120, 1)))


def test_camera_follows_the_mean_of_walking_robots_at_their_speed_within_the_dead_zone():
    paths = np.stack([walk(4.0, 4.0), walk(4.0, 4.0) + [0.0, 1.5, 0.0]], axis=1)  # 1 m/s
    target = follow(paths, 1.0 / RATE)
    assert target[:, 1:] == pytest.approx(np.tile([0.75, STANDING], (241, 1)))
    middle = slice(90, 150)
    assert np.diff(target[middle, 0]) == pytest.approx(1.0 / RATE, rel=1e-6)
    assert (paths[middle, 0, 0] - target[middle, 0]) == pytest.approx(DEAD_ZONE[0], abs=1e-6)


def test_camera_moves_smoothly_after_a_leap_and_catches_up():
    leap = np.concatenate([np.tile([0.0, 0.0, 0.3], (60, 1)), np.tile([2.0, 0.0, 0.3], (60, 1))])
    target = follow(leap[:, None], 1.0 / RATE)[:, 0]
    steps = np.diff(target)
    assert steps.min() > -1e-9 and steps.max() < 0.05  # [m] a frame, where the robot leaps 2 m
    assert np.abs(np.diff(steps)).max() < 0.004
    assert target[[0, -1]] == pytest.approx([0.0, 2.0 - DEAD_ZONE[0]], abs=1e-3)


def test_paths_of_later_worlds_are_drawn_apart():
    places = np.zeros((3, 3, 3)) + np.arange(3)[:, None, None] * [0.1, 0.0, 0.0]
    drawn = body_paths(box_recording(places, spacing=1.5), [0, 2])
    assert drawn[2] == pytest.approx(np.array([[0.2, 0.0, 0.0], [0.2, 3.0, 0.0]]))


def test_arrows_show_commanded_velocity_of_a_turned_robot_and_its_actual_velocity():
    yaw = math.radians(120.0)
    path = walk(0.6, 1.0) @ np.array([[0.0, -1.0, 0.0], [0.0, 0.0, 0.0], [0.0, 0.0, 1.0]])  # 0.6 m/s along -y
    path[:, 2] += 0.1 * np.arange(len(path))  # which no arrow shows
    commands = np.tile(np.float32([0.5, 0.2, 0.9]), (len(path), 1, 1))
    start = np.array([1.0, 2.0, 3.0])
    arrows = velocity_arrows(box_recording(path, yaw=yaw, commands=commands), 30, 0, start)
    assert [arrow.color for arrow in arrows] == [COMMAND_COLOR, ACTUAL_COLOR] and all(arrow.arrow for arrow in arrows)
    spans = [(arrow.points[-1] - arrow.points[0]) / ARROW_SECONDS for arrow in arrows]
    turned = (0.5 + 0.2j) * np.exp(1j * yaw)  # ahead + i left, turned
    assert spans[0] == pytest.approx([turned.real, turned.imag, 0.0], abs=1e-6)
    assert spans[1] == pytest.approx([0.0, -0.6, 0.0], abs=1e-5)
    assert arrows[1].points[0] == pytest.approx(start)


def ink(image):
    """Return rows and columns of the dark pixels of an image."""
    return np.nonzero(np.asarray(image).max(axis=2) < 90)


def test_label_stands_above_its_point_and_is_skipped_behind_the_eye():
    grey, view = np.full((120, 200, 3), 160, np.uint8), View(np.array([-3.0, 0.0, 0.0]), np.zeros(3))
    point = np.array([0.5, 0.6, -0.3])
    picture = annotate(grey, view, [Label("HH", point), Label("HH", np.array([-4.0, 0.0, 0.0]))], size=0.1)
    rows, columns = ink(picture)
    ((column, row),) = pinhole([point], view.eye, view.target, view.field_of_view, (200, 120))
    assert 0.5 * (columns.min() + columns.max() + 1) == pytest.approx(column, abs=1.5)
    assert row - 5.0 < rows.max() <= row  # [px] above the point, by the font's descent
    assert (grey == 160).all()


def test_block_that_waits_far_away_is_no_divergence():  # courses keep their block 1 km away until it is needed
    recording = box_recording(walk(0.5))
    frames = len(recording.times)
    centers, half, height = np.full((frames, 1, 2), 1000.0), np.full((1, 2), 0.5), np.array([0.05])  # [m]
    assert valid_frames(with_blocks(recording, centers, half, height), 0) == frames
