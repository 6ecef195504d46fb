"""Films of recordings, read back by ffmpeg and Pillow."""

import imageio_ffmpeg
import numpy as np
import pytest
from PIL import Image
from scipy.spatial.transform import Rotation

from box_robot import RATE, box_recording, colored, pinhole, walk
from columns import POS
from jumper_warp.utils.errors import InputError
from jumper_warp.viz import film
from jumper_warp.viz.film import drawn_poses, write_film
from jumper_warp.viz.renderer import RayTracer

SIZE = (96, 64)  # [px]
GREEN = 1  # channel


class Canvas:
    """Stub of a renderer that draws nothing and stores its arguments."""

    name = "nothing"

    def __init__(self, shapes, num_bodies, size, opacity=(1.0,)):
        self.shapes, self.size, self.poses, self.views, self.lines = shapes, size, [], [], []

    def draw(self, poses, view, lines=()):
        """Store the arguments; return an image (height, width, 3) of one grey level that counts the images."""
        self.poses.append(poses), self.views.append(view), self.lines.append(lines)
        return np.full((self.size[1], self.size[0], 3), len(self.views) % 120 * 2, np.uint8)

    def __enter__(self):
        return self

    def __exit__(self, *_):
        pass


@pytest.fixture
def canvas(monkeypatch):
    """Return the list of canvases that replace renderers."""
    opened = []

    def open_canvas(*args):
        opened.append(Canvas(*args))
        return opened[-1]

    monkeypatch.setattr(film, "open_renderer", open_canvas)
    return opened


def durations(path):
    """Return the duration of each frame of an animation [ms]."""
    with Image.open(path) as animation:
        times = []
        for frame in range(animation.n_frames):
            animation.seek(frame)
            animation.load()
            times.append(animation.info["duration"])
    return times


def test_mp4_is_h264_in_yuv420p_with_even_size_and_the_recordings_duration(tmp_path):
    path = write_film(box_recording(walk(1.0)), tmp_path / "new" / "walk.mp4", size=(95, 63), fps=30.0)
    frames = imageio_ffmpeg.read_frames(str(path))
    meta = next(frames)
    images = [np.frombuffer(frame, np.uint8).reshape(64, 96, 3) for frame in frames]
    assert (meta["codec"], meta["size"], meta["fps"]) == ("h264", (96, 64), 30.0)
    assert meta["pix_fmt"].startswith("yuv420p")
    assert imageio_ffmpeg.count_frames_and_secs(str(path)) == (16, pytest.approx(16 / 30.0, abs=0.02))
    assert all(colored(image, GREEN).sum() > 20 for image in images)  # the robot stays in view
    assert [file.name for file in path.parent.iterdir()] == ["walk.mp4"]


@pytest.mark.parametrize("suffix", [".webp", ".gif"])
@pytest.mark.parametrize(("fps", "frames"), [(15.0, 8), (30.0, 16)])
def test_animation_has_frames_and_duration_of_the_recording_and_repeats(tmp_path, canvas, suffix, fps, frames):
    path = write_film(box_recording(walk(1.0)), tmp_path / f"walk{suffix}", size=SIZE, fps=fps)
    with Image.open(path) as animation:
        assert (animation.n_frames, animation.size, animation.info["loop"]) == (frames, SIZE, 0)
    shown = durations(path)
    assert sum(shown) == pytest.approx(1000.0 * frames / fps, abs=6.0)  # [ms]
    assert max(shown) - min(shown) <= 10  # [ms]


def test_robots_stay_in_view_of_the_default_camera(tmp_path, canvas):
    places = np.stack([walk(3.0, 2.0), walk(-1.0, 2.0)], axis=1)
    places[30, :, 2] = 1.2
    write_film(box_recording(places, spacing=1.0), tmp_path / "two.webp", size=SIZE, fps=15.0)
    (drawn,) = canvas
    for view, poses in zip(drawn.views, drawn.poses, strict=True):
        pixels = pinhole(poses[:, POS], view.eye, view.target, view.field_of_view, SIZE)
        assert (pixels > 0.0).all() and (pixels < SIZE).all()
    assert drawn.poses[0][1, 1] - drawn.poses[0][0, 1] == pytest.approx(1.0)  # [m] apart


@pytest.mark.parametrize("tracing", [False, True])
@pytest.mark.parametrize("value", [np.nan, 1.0e9])
def test_diverged_robot_is_shown_until_then(tmp_path, monkeypatch, tracing, value):
    if tracing:
        monkeypatch.setattr(film, "open_renderer", RayTracer)
    recording = box_recording(walk(0.5))
    recording.poses[16:] = value
    recording.contact_points[16:] = value
    shown = []
    with Image.open(write_film(recording, tmp_path / "lost.gif", size=SIZE, fps=15.0)) as animation:
        for frame in range(animation.n_frames):
            animation.seek(frame)
            shown.append(int(colored(animation.convert("RGB"), GREEN).sum()))
    assert min(shown[:4]) > 20 and max(shown[4:]) == 0  # [px] frames at 0, 4, 8, 12, 16 ... of the recording


def test_interpolated_poses_are_unit_quaternions_halfway_and_exact_at_recorded_times():
    recording = box_recording(walk(1.0))
    angles = np.array([0.0, 40.0, 80.0, 170.0])
    recording.poses[:4, 0, 3:] = Rotation.from_rotvec(angles[:, None] * [0.0, 1.0, 0.0], degrees=True).as_quat()
    recording.poses[2, 0, 3:] *= -1.0  # the same rotation
    exact = drawn_poses(recording, recording.times)
    assert exact[..., :3] == pytest.approx(recording.poses[..., POS].astype(float), abs=1e-6)
    signs = (exact[..., 3:] * recording.poses[..., 3:]).sum(axis=-1)
    assert np.abs(signs) == pytest.approx(1.0, abs=1e-6)  # equal up to sign, thus the same rotation
    between = drawn_poses(recording, recording.times[:3] + 0.5 / RATE)
    assert np.linalg.norm(between[..., 3:], axis=-1) == pytest.approx(1.0)
    turned = np.degrees(Rotation.from_quat(between[:, 0, 3:]).magnitude())
    assert turned == pytest.approx([20.0, 60.0, 125.0], abs=1e-3)
    assert between[:, 0, 0] == pytest.approx(np.array([0.5, 1.5, 2.5]) / 30.0)


@pytest.mark.parametrize(
    ("suffix", "settings", "message"),
    [
        (".webp", {"ranks": [-1]}, "rank must be in 0 to 0, got -1"),
        (".webp", {"ranks": []}, "number of ranks"),
        (".gif", {"fps": 0.001}, "fps in"),
        (".mp4", {"speed": 1.0e-9}, "up to 1000000 frames"),
        (".webp", {"speed": 1.0e-3}, "use .mp4"),
    ],
)
def test_impossible_film_is_refused(tmp_path, canvas, suffix, settings, message):
    with pytest.raises(InputError, match=message):
        write_film(box_recording(walk(1.0)), tmp_path / f"film{suffix}", size=SIZE, **settings)
    assert not canvas and not list(tmp_path.iterdir())
