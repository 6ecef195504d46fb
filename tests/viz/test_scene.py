"""Framing, following, velocity arrows and labels, against an independent pinhole camera and hand-made motions."""

import math

import numpy as np
import pytest

from box_robot import RATE, STANDING, box_recording, pinhole, walk
from jumper_warp.viz.scene import ARROW_SECONDS, DEAD_ZONE, MARGIN, fit, follow, velocity_arrows
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
    assert np.cross(ahead, direction) == pytest.approx(0.0, abs=1e-6 * np.linalg.norm(ahead))
    assert ahead @ direction < 0.0
    assert out_of_view(points, view, view.eye) <= 1.0 + 1e-6
    assert out_of_view(points, view, view.eye + 0.03 * ahead) > 1.0


def test_camera_follows_the_mean_of_walking_robots_at_their_speed_within_the_dead_zone():
    paths = np.stack([walk(4.0, 4.0), walk(4.0, 4.0) + [0.0, 1.5, 0.0]], axis=1)  # 1 m/s
    target = follow(paths, 1.0 / RATE)
    assert target[:, 1:] == pytest.approx(np.tile([0.75, STANDING], (241, 1)))
    middle = slice(90, 150)
    assert np.diff(target[middle, 0]) == pytest.approx(1.0 / RATE, rel=1e-6)
    assert (paths[middle, 0, 0] - target[middle, 0]) == pytest.approx(DEAD_ZONE[0], abs=1e-6)


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
