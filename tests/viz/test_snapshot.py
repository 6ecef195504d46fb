"""Ray-traced images of a model, against pinhole optics, and sheets of images."""

import matplotlib.image
import newton
import numpy as np
import pytest
import warp as wp

from jumper_warp.viz import snapshot


@pytest.fixture(scope="module")
def model():
    """Return a model of two worlds: a red ball of radius 0.2 m in world 0, a blue one in world 1."""
    scene = newton.ModelBuilder()
    for color in ((1.0, 0.0, 0.0), (0.0, 0.0, 1.0)):
        world = newton.ModelBuilder()
        ball = world.add_link(mass=1.0, inertia=wp.mat33(np.eye(3)))
        world.add_articulation([world.add_joint_free(ball)])
        world.add_shape_sphere(ball, radius=0.2, color=color)
        scene.add_world(world)
    return scene.finalize(device="cpu")


@pytest.fixture(scope="module")
def state(model):
    """Return a state with both balls at y = 0.5 m, to the left of an eye on the x axis that looks along +x."""
    state = model.state()
    state.body_q.assign(np.tile([0.0, 0.5, 0.0, 0.0, 0.0, 0.0, 1.0], (2, 1)).astype(np.float32))
    return state


def colored(picture, channel):
    """Return whether each pixel's RGB channel exceeds the others by over 60 of 255, bool (height, width)."""
    others = np.delete(picture.astype(int), channel, axis=2).max(axis=2)
    return picture[..., channel] > others + 60


def test_camera_at_the_eye_looks_along_minus_z_with_y_up():
    pose = snapshot.look_at((-2.0, 0.0, 0.0), (0.0, 0.0, 0.0))
    rotation = wp.transform_get_rotation(pose)
    assert list(wp.quat_rotate(rotation, wp.vec3(0.0, 0.0, -1.0))) == pytest.approx([1.0, 0.0, 0.0], abs=1e-6)
    assert list(wp.quat_rotate(rotation, wp.vec3(0.0, 1.0, 0.0))) == pytest.approx([0.0, 0.0, 1.0], abs=1e-6)
    assert list(wp.transform_get_translation(pose)) == [-2.0, 0.0, 0.0]


def test_ball_has_position_and_size_of_pinhole_optics(model, state):
    camera = snapshot.Camera(model, eye=(-2.0, 0.0, 0.0), target=(0.0, 0.0, 0.0), size=(200, 160))
    rows, columns = np.nonzero(colored(camera.picture(state), 0))
    # focal length in px: 80 / tan(20 deg) = 219.8; the ball's centre is 0.5 m to the left at 2 m: 55 px
    assert columns.mean() == pytest.approx(99.5 - 55.0, abs=2.0)
    assert rows.mean() == pytest.approx(79.5, abs=2.0)
    assert np.ptp(rows) + 1 == pytest.approx(2 * 219.8 * 0.2 / 2.0, abs=3.0)


def test_camera_draws_only_its_world(model, state):
    pictures = [
        snapshot.Camera(model, eye=(-2.0, 0.0, 0.0), target=(0.0, 0.0, 0.0), size=(64, 48), world=world).picture(state)
        for world in (0, 1)
    ]
    assert [bool(colored(picture, 0).any()) for picture in pictures] == [True, False]
    assert [bool(colored(picture, 2).any()) for picture in pictures] == [False, True]


def test_picture_follows_the_state_and_leaves_the_previous_picture(model, state):
    camera = snapshot.Camera(model, eye=(-2.0, 0.0, 0.0), target=(0.0, 0.0, 0.0), size=(64, 48))
    before = camera.picture(state)
    moved = model.state()
    moved.body_q.assign(np.tile([0.0, -0.5, 0.0, 0.0, 0.0, 0.0, 1.0], (2, 1)).astype(np.float32))
    after = camera.picture(moved)
    assert np.nonzero(colored(before, 0))[1].mean() < 32.0 < np.nonzero(colored(after, 0))[1].mean()  # [px] of 64


def test_contact_sheet_keeps_order_and_pixels(tmp_path):
    shades = [np.full((30, 40, 3), shade, dtype=np.uint8) for shade in (10, 100, 200)]
    sheet = matplotlib.image.imread(snapshot.contact_sheet(shades, tmp_path / "sheet.png", columns=2))
    assert sheet.shape[:2] == (60, 80)
    middles = [sheet[15, 20, 0], sheet[15, 60, 0], sheet[45, 20, 0], sheet[45, 60, 0]]  # the last place is empty
    assert 255 * np.array(middles) == pytest.approx([10, 100, 200, 255], abs=0.5)


def test_contact_sheet_is_one_row_by_default_and_shows_captions(tmp_path):
    shades = [np.full((30, 60, 3), 255, dtype=np.uint8)] * 3
    sheet = matplotlib.image.imread(snapshot.contact_sheet(shades, tmp_path / "strip.png", ["", "0.5 s", ""]))
    assert sheet.shape[:2] == (30, 180)
    ink = (sheet[..., :3] < 0.5).any(axis=(0, 2))  # (180,) columns with dark pixels
    assert ink[60:120].any() and not ink[:60].any() and not ink[120:].any()  # the second picture alone


@pytest.mark.parametrize(
    ("pictures", "captions", "message"),
    [
        ([], None, "needs pictures"),
        ([np.zeros((2, 2, 3), np.uint8), np.zeros((2, 3, 3), np.uint8)], None, "one size"),
        ([np.zeros((2, 2, 3), np.uint8)], ["a", "b"], "1 pictures have 2 captions"),
    ],
)
def test_contact_sheet_refuses_bad_pictures_and_captions(tmp_path, pictures, captions, message):
    with pytest.raises(ValueError, match=message):
        snapshot.contact_sheet(pictures, tmp_path / "sheet.png", captions)


def test_camera_refuses_a_vertical_view_and_a_missing_world(model):
    with pytest.raises(ValueError, match="no horizontal distance"):
        snapshot.look_at((0.0, 0.0, 2.0), (0.0, 0.0, 0.0))
    with pytest.raises(ValueError, match="world 2"):
        snapshot.Camera(model, world=2)
