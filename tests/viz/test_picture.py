"""Composite pictures of hand-made jumps and walks."""

import numpy as np
import pytest

from box_robot import GREEN, RATE, STANDING, box_recording, pinhole, walk
from columns import XY, X, Z
from jumper_warp.viz import picture
from jumper_warp.viz.picture import GAP, MOST, SPREAD, compose, write_picture

GRAVITY = 9.81  # [m/s²]
SQUAT, TAKEOFF, APEX, TOUCHDOWN, REST = 12, 20, 44, 68, 88  # frames of `jump`
WIDTH = 240  # [px]


def jump(distance=0.0, gravity=GRAVITY):
    """Return base positions [m], (89, 3), and paw force [N], (89,), of a jump: squat, push, flight, landing, rest.

    The base moves by a distance [m] along x during the flight. gravity: [m/s²].
    """
    knots = ([0, SQUAT, TAKEOFF], [STANDING, 0.18, STANDING])
    height = np.interp(np.arange(REST + 1.0), *knots)
    flight = np.arange(TAKEOFF, TOUCHDOWN + 1)
    time = (flight - TAKEOFF) / RATE
    height[flight] += 0.5 * gravity * time * ((TOUCHDOWN - TAKEOFF) / RATE - time)
    height[TOUCHDOWN + 1 :] = np.interp(np.arange(TOUCHDOWN + 1, REST + 1), [TOUCHDOWN, 76, REST], [0.3, 0.22, 0.3])
    along = np.interp(np.arange(REST + 1), [TAKEOFF, TOUCHDOWN], [0.0, distance])
    force = np.full(REST + 1, 150.0)
    force[flight] = 0.0
    return np.stack([along, 0.0 * along, height], axis=1), force


def jump_recording(distance=0.0, **fields):
    """Return a recording of `jump`."""
    positions, forces = jump(distance)
    return box_recording(positions, forces=forces, **fields)


def test_jump_in_place_is_shown_from_squat_to_rest_and_spread():
    scene = compose(jump_recording())
    assert list(scene.frames[[0, 1, 3, 5, 6]]) == [SQUAT, TAKEOFF, APEX, TOUCHDOWN, REST]
    assert TAKEOFF < scene.frames[2] < APEX < scene.frames[4] < TOUCHDOWN
    assert scene.flights == [(TAKEOFF, TOUCHDOWN)]
    assert np.diff(scene.bases[:, X]) == pytest.approx(SPREAD) and scene.shift.mean() == pytest.approx(0.0)
    assert scene.bases[:, Z] == pytest.approx(jump()[0][scene.frames, 2], abs=1e-6)


@pytest.mark.parametrize("heading", [0.0, 2.0])
def test_horizontal_jump_keeps_its_places_and_runs_to_the_right(heading):
    positions, forces = jump(1.5)
    turned = np.array([[np.cos(heading), np.sin(heading), 0.0], [-np.sin(heading), np.cos(heading), 0.0], [0, 0, 1.0]])
    scene = compose(box_recording(positions @ turned, forces=forces))
    assert not scene.shift.any()
    assert scene.right == pytest.approx(turned[0], abs=1e-6)
    assert scene.bases == pytest.approx((positions @ turned)[scene.frames], abs=1e-6)
    assert {0, APEX, REST} <= set(scene.frames) and len(scene.frames) <= MOST
    distance = np.linalg.norm(scene.bases[:, None] - scene.bases, axis=-1)
    assert distance[~np.eye(len(distance), dtype=bool)].min() >= GAP - 1e-6  # [m]


@pytest.mark.parametrize(
    ("distance", "goal", "eye", "spread"),
    [
        (0.5, 0.5, None, False), (0.5, np.nan, None, True), (0.0, 0.5, None, False), (0.0, 0.1, None, True),
        (0.5, 0.5, (0.0, -1.0, 0.1), False), (0.5, 0.5, (1.0, 0.0, 0.1), True),
    ],
)  # fmt: skip
def test_jump_to_a_goal_away_from_its_start_is_to_scale_with_the_goal(distance, goal, eye, spread):
    """From the front (eye ahead), start and goal are at one place of the picture, and moments are spread."""
    recording = jump_recording(distance, goals=np.array([[[goal, 0.0, 0.0]]]))
    scene = compose(recording, eye=eye)
    assert scene.stays == spread and (scene.shift.any() == spread)
    assert any(shape.name == "goal_0_0" for shape in picture._shapes(scene)) == (not spread)


def test_lifted_paws_without_rise_are_no_jump():
    forces = np.full(61, 100.0)
    forces[10:20] = 0.0  # a trot with a flight phase
    assert compose(box_recording(walk(2.0, 1.0), forces=forces)).flights == []


def test_later_world_is_drawn_at_its_true_place_with_its_goal_and_height(tmp_path, monkeypatch):
    positions, forces = jump(1.5)
    places = np.stack([0.0 * positions + [0.0, 0.0, 0.3], positions], axis=1)
    goals = np.array([[[0.4, 0.0, 0.0]], [[1.5, 0.1, 0.0]]])
    recording = box_recording(places, forces=forces, spacing=2.0, goals=goals, heights=np.array([0.5, 0.9]))
    drawn = []
    opened = picture.open_renderer

    def spy(shapes, num_bodies, size, opacity):
        renderer = opened(shapes, num_bodies, size, opacity)
        draw = renderer.draw

        def keep(poses, view, lines):
            drawn.append((shapes, size, poses, view))
            return draw(poses, view, lines)

        renderer.draw = keep
        return renderer

    monkeypatch.setattr(picture, "open_renderer", spy)
    write_picture(recording, tmp_path / "jump.png", rank=1, width=WIDTH)
    ((shapes, size, poses, view),) = drawn
    assert poses[:, 0, :3] == pytest.approx(positions[compose(recording, 1).frames], abs=1e-6)
    (ring,) = (shape for shape in shapes if shape.name.startswith("goal"))
    assert ring.vertices[:, XY].mean(axis=0) == pytest.approx([1.5, 0.1], abs=1e-5)
    assert sum(shape.color == GREEN for shape in shapes) == 1  # the other world's robot is not drawn
    pixels = pinhole(np.concatenate([poses[:, 0, :3], goals[1]]), view.eye, view.target, view.field_of_view, size)
    assert (pixels > 0.0).all() and (pixels < size).all()
    assert (np.diff(pixels[:-1, 0]) > 0.0).all()  # from left to right
    assert list(compose(recording, 1).heights) == [pytest.approx(0.9)]
