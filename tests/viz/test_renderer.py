"""Images by OpenGL and by ray tracing, against pinhole optics."""

import importlib
import math
import os
import subprocess
import sys
from contextlib import suppress
from importlib.util import find_spec

import numpy as np
import pytest
import trimesh

from box_robot import colored, pinhole, shape
from jumper_warp.viz.renderer import GLRenderer, Line, RayTracer, View

SIZE = (96, 64)  # [px] width, height
RADIUS = 0.2  # [m] of the balls
RED, BLUE = 0, 2  # channels
BALL = shape(trimesh.creation.icosphere(subdivisions=3, radius=RADIUS), (1.0, 0.0, 0.0))
FIXED = shape(trimesh.creation.icosphere(subdivisions=3, radius=RADIUS), (0.0, 0.0, 1.0), -1)
VIEW = View(np.array([-2.0, 0.0, 0.0]), np.zeros(3), 40.0)  # along +x, so y is to the left
FOCAL = 0.5 * SIZE[1] / math.tan(math.radians(20.0))  # [px]


def poses(*positions):
    """Return poses (n, 7) of bodies at positions [m], not turned."""
    return np.array([[*position, 0.0, 0.0, 0.0, 1.0] for position in positions])


DRAW_THEN_IMPORT = """
from jumper_warp.viz.renderer import GLRenderer
GLRenderer([], 0, (96, 64)).close()
import triton
"""  # as a notebook that draws a picture and then trains


@pytest.fixture(scope="module")
def opengl():
    """Skip tests if pyglet cannot open a window, unless the environment sets REQUIRE_OPENGL.

    CI installs OpenGL and sets the variable. Any later failure is a fault of the renderer.
    """
    pyglet = pytest.importorskip("pyglet")
    with suppress(ImportError):  # as in the renderer: its LLVM before that of Mesa
        importlib.import_module("triton")
    pyglet.options["headless"] = True
    try:
        from pyglet.window import Window

        Window(width=16, height=16, visible=False).close()
    except Exception as error:  # pyglet raises many kinds, of no common base
        if os.environ.get("REQUIRE_OPENGL"):
            raise
        pytest.skip(f"no OpenGL: {error}")


@pytest.fixture(scope="module", params=[GLRenderer, RayTracer], ids=["OpenGL", "ray tracing"])
def kind(request):
    """Class of a renderer."""
    if request.param is GLRenderer:
        request.getfixturevalue("opengl")
    return request.param


@pytest.fixture(scope="module")
def one_ball(kind):
    """Renderer of one red ball, a body, and one blue ball that is fixed at the world's origin."""
    with kind([BALL, FIXED], 1, SIZE) as renderer:
        yield renderer


def test_ball_has_position_and_size_of_pinhole_optics(one_ball):
    rows, columns = np.nonzero(colored(one_ball.draw(poses((0.0, 0.6, 0.0)), VIEW), RED))
    aside, half = math.atan2(0.6, 2.0), math.asin(RADIUS / math.hypot(0.6, 2.0))  # angles to the left of the view
    edges = [0.5 * SIZE[0] - FOCAL * math.tan(aside + side * half) for side in (1, -1)]
    assert [columns.min(), columns.max() + 1] == pytest.approx(edges, abs=1.0)  # [px]
    height = FOCAL * RADIUS / math.sqrt(2.0**2 - RADIUS**2)  # half of the ellipse that a ball's image is
    assert [rows.min(), rows.max() + 1] == pytest.approx([32.0 - height, 32.0 + height], abs=1.0)


@pytest.mark.parametrize("place", [(0.3, -0.5, 0.4), (0.6, -0.7, -0.2), (0.9, 0.2, 0.0)])
def test_drawn_ball_is_where_the_view_projects_it(one_ball, place):
    view = View(np.array([1.5, -2.0, 0.9]), np.array([0.2, 0.1, 0.0]), 40.0)
    rows, columns = np.nonzero(colored(one_ball.draw(poses(place), view), RED))
    (pixel,) = view.project(np.array([place]), SIZE)
    assert [columns.mean() + 0.5, rows.mean() + 0.5] == pytest.approx(pixel, abs=1.0)
    assert pixel == pytest.approx(pinhole([place], view.eye, view.target, 40.0, SIZE)[0], abs=1e-9)


def test_body_follows_its_pose_and_a_fixed_shape_stays(one_ball):
    images = [one_ball.draw(poses((0.0, y, 0.5)), VIEW) for y in (0.5, -0.5)]
    left, right = (np.nonzero(colored(image, RED))[1].mean() for image in images)
    assert left < 0.5 * SIZE[0] - 15.0 and right > 0.5 * SIZE[0] + 15.0  # [px]
    blue = [np.argwhere(colored(image, BLUE)).mean(axis=0) + 0.5 for image in images]
    assert np.array(blue) == pytest.approx(np.tile([32.0, 48.0], (2, 1)), abs=1.0)


def test_rotation_of_a_body_turns_its_shapes(kind):
    stick = shape(trimesh.creation.box(extents=(0.1, 0.8, 0.1)), (1.0, 0.0, 0.0))
    upright = [[0.0, 0.0, 0.0, math.sqrt(0.5), 0.0, 0.0, math.sqrt(0.5)]]  # 90 degrees about x
    with kind([stick], 1, SIZE) as renderer:
        extents = [np.ptp(np.argwhere(colored(renderer.draw(np.array(pose), VIEW), RED)), axis=0) for pose in
                   (poses((0.0, 0.0, 0.0)), upright)]  # fmt: skip
    assert extents[0][1] > 3 * extents[0][0] and extents[1][0] > 3 * extents[1][1]


def test_opacity_mixes_a_copy_with_the_background(opengl):
    with GLRenderer([BALL], 1, SIZE, (1.0, 0.3)) as renderer:
        image = renderer.draw(poses((0.0, 0.5, 0.0), (0.0, -0.5, 0.0)), VIEW).astype(float)
    solid, ghost = image[32, 26], image[32, 70]  # at the balls' middles, 22 px from the image's
    sky = image[32, 48]
    assert ghost == pytest.approx(0.3 * solid + 0.7 * sky, abs=10.0)  # of 255
    assert solid[1] < ghost[1] < sky[1]


@pytest.mark.parametrize("arrow", [False, True])
def test_line_is_drawn_between_its_points_and_only_in_its_image(opengl, arrow):
    line = Line(np.array([[0.0, 0.6, 0.4], [0.0, -0.6, 0.4]]), (0.0, 0.0, 1.0), arrow)
    with GLRenderer([BALL], 1, SIZE) as renderer:
        drawn, empty = (renderer.draw(poses((0.0, 0.0, 0.0)), VIEW, lines) for lines in ([line], []))
    rows, columns = np.nonzero(colored(drawn, BLUE))
    ends = pinhole(line.points, VIEW.eye, VIEW.target, 40.0, SIZE)
    assert [columns.min(), columns.max() + 1] == pytest.approx(ends[:, 0], abs=3.0)
    assert rows.mean() + 0.5 == pytest.approx(ends[0, 1], abs=1.5)
    assert not colored(empty, BLUE).any()


def test_arrow_has_its_head_at_the_last_point(opengl):
    line = Line(np.array([[0.0, 0.6, 0.4], [0.0, -0.6, 0.4]]), (0.0, 0.0, 1.0), arrow=True)
    with GLRenderer([BALL], 1, (960, 640)) as renderer:  # lines of the small image are one pixel wide
        columns = np.nonzero(colored(renderer.draw(poses((0.0, 0.0, 0.0)), VIEW, [line]), BLUE))[1]
    start, *_, end = np.array_split(np.bincount(columns)[columns.min() :], 10)  # [px] thickness along the arrow
    assert end.max() >= 2 * start.max()


@pytest.mark.skipif(find_spec("triton") is None, reason="needs triton")
def test_triton_can_be_imported_after_a_picture(opengl):
    result = subprocess.run([sys.executable, "-c", DRAW_THEN_IMPORT], capture_output=True, text=True, check=False)
    assert result.returncode == 0, result.stderr


def test_points_behind_the_eye_have_no_pixel():
    pixels = VIEW.project(np.array([[-2.5, 0.0, 0.0], [0.0, 0.0, 0.0]]), SIZE)
    assert np.isnan(pixels[0]).all() and pixels[1] == pytest.approx([48.0, 32.0])
