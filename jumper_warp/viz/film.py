"""Export of recordings as films: H.264 in MP4, animated WebP or GIF."""

from __future__ import annotations

import errno
import io
import os
import subprocess
from collections.abc import Iterator, Sequence
from contextlib import suppress
from importlib.util import find_spec
from pathlib import Path

import numpy as np
from PIL import Image

from jumper_warp.utils.checks import check_count, check_type
from jumper_warp.utils.errors import InputError
from jumper_warp.utils.files import Json, write_atomically
from jumper_warp.utils.progress import phase
from jumper_warp.viz import scene
from jumper_warp.viz.props import goal_shapes
from jumper_warp.viz.recording import Recording
from jumper_warp.viz.renderer import FIELD_OF_VIEW, Line, View, open_renderer
from jumper_warp.viz.shapes import ShapeMesh
from jumper_warp.viz.style import BASE_COLOR, LEG_COLORS

SUFFIXES = (".mp4", ".webp", ".gif")
DIRECTION = (0.62, -1.0, 0.28)  # from the robots to the camera, world frame: on their right, ahead, above
MAX_FRAMES = 1800  # of WebP and GIF, which are encoded in memory
MOST_FRAMES = 10**6  # of MP4
SLOWEST = 0.01  # [1/s] Least frames per second; a frame of a GIF may last 655 s
GIF_FPS = 50.0  # [1/s] largest frame rate of a GIF: players slow down images shorter than 20 ms
TRAIL_SECONDS = 1.5  # [s] length of the trails of base and paws


def write_film(
    recording: Recording,
    path: Path,
    *,
    size: tuple[int, int] = (854, 480),
    fps: float = 30.0,
    speed: float = 1.0,
    eye: Sequence[float] | None = None,
    field_of_view: float = FIELD_OF_VIEW,
    ranks: Sequence[int] | None = None,
) -> Path:
    """Write a film whose camera follows the robots; return its path. The suffix .mp4, .webp or .gif is the format.

    size: width and height [px], rounded up to even numbers. fps: frames per second of the film. speed: playback speed,
    0.25 for slow motion. eye: offset [m] of the camera from the robots' mean position, world frame (default: to their
    right, at the least distance that shows all). field_of_view: vertical angle of view [deg]. ranks: indices in
    `recording.worlds`, shown side by side (default: all). Raises InputError: see `check_film`, or too many frames for
    the format; OSError.
    """
    check_type("recording", recording, Recording)
    path = Path(path)
    width, height = (pixels + pixels % 2 for pixels in size)
    size = (width, height)
    check_film(path, size, fps, speed, eye)
    View(np.array([1.0, 0.0, 0.0]), np.zeros(3), field_of_view).axes()
    count = int((recording.times[-1] - recording.times[0] + 1.0e-9) * fps / speed) + 1
    most = MOST_FRAMES if path.suffix == ".mp4" else MAX_FRAMES
    if count > most:
        hint = "" if path.suffix == ".mp4" else "; use .mp4"
        raise InputError(f"{path}: {path.suffix} may have up to {most} frames, got {count}{hint}")
    times = np.arange(recording.times[0], recording.times[-1] + 1.0e-9, speed / fps)
    ranks = range(len(recording.worlds)) if ranks is None else ranks
    check_type("ranks", ranks, Sequence[int])
    check_count("number of ranks", len(ranks))
    recording = scene.without_divergence(recording)
    path.parent.mkdir(parents=True, exist_ok=True)
    images = _images(recording, times, size, eye, field_of_view, ranks, path.name)
    if path.suffix != ".mp4":
        write_atomically(path, _encoded_animation(images, path.suffix[1:], fps, len(times)))
        return path
    temporary = path.with_name(f".{os.getpid()}.{path.name}")
    try:
        _encode_mp4(temporary, path, images, size, fps)
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)
    return path


def check_film(path: Path, size: tuple[int, int], fps: float, speed: float, eye: Sequence[float] | None = None) -> None:
    """Raise InputError unless a film can be written with these arguments of `write_film`."""
    path = Path(path)
    check_type("size", tuple(size) if isinstance(size, Sequence) else size, tuple[int, int])
    check_type("fps", fps, float)
    check_type("speed", speed, float)
    if path.suffix not in SUFFIXES:
        raise InputError(f"{path}: the suffix of a film must be one of {', '.join(SUFFIXES)}")
    if path.suffix == ".mp4" and find_spec("imageio_ffmpeg") is None:
        raise InputError('MP4 films need imageio-ffmpeg: pip install "jumper-warp[video]"')
    if not (64 <= min(size) and max(size) <= 7680 and SLOWEST <= fps <= 240.0 and 0.0 < speed <= 100.0):
        raise InputError(
            f"a film needs 64 to 7680 px, fps in [{SLOWEST}, 240], speed in (0, 100]; got {size}, {fps}, {speed}"
        )
    if path.suffix == ".gif" and fps > GIF_FPS:
        raise InputError(f"{path}: a GIF may have up to {GIF_FPS:g} frames per second, got {fps:g}")
    if eye is not None:
        _view(np.zeros((0, 0, 3)), size, eye).axes()


def _images(
    recording: Recording,
    times: np.ndarray,
    size: tuple[int, int],
    eye: Sequence[float] | None,
    field_of_view: float,
    ranks: Sequence[int],
    name: str,
) -> Iterator[Image.Image]:
    """Yield the annotated images of a film at `times` [s], with a progress bar; name: label of the bar."""
    frames = np.clip(np.searchsorted(recording.times, times - 1.0e-9), 0, len(recording.times) - 1)
    poses = drawn_poses(recording, times)
    paths = scene.body_paths(recording, ranks)
    targets = scene.follow(paths, float(np.mean(np.diff(recording.times))) if len(recording.times) > 1 else 1.0)
    seen = paths - targets[:, None]
    if len(recording.commands) or not recording.contact_forces.any():  # arrows; raised legs of a floating robot
        seen = np.concatenate([seen, seen + [0.0, 0.0, scene.REACH - scene.ABOVE]], axis=1)
    frame_view = _view(seen, size, eye, field_of_view)
    targets = _interpolated(recording, targets, times)
    bases = _interpolated(recording, paths, times)
    with (
        open_renderer(_shapes(recording, ranks), len(recording.bodies), size) as renderer,
        phase(f"drawing {name} with {renderer.name}", len(times)) as advance,
    ):
        for i, (frame, time) in enumerate(zip(frames, times, strict=True)):
            view = View(targets[i] + frame_view.eye, targets[i] + frame_view.target, field_of_view)
            image = renderer.draw(poses[i], view, _lines(recording, paths, bases[i], frame, ranks))
            named = zip(ranks, bases[i], strict=True) if len(ranks) > 1 else ()
            labels = [scene.Label(recording.label(rank), base + [0.0, 0.0, 0.18]) for rank, base in named]
            yield scene.annotate(image, view, labels, f"{recording.heading(ranks)}   {time:.2f} s".strip())
            advance()


def _shapes(recording: Recording, ranks: Sequence[int]) -> list[ShapeMesh]:
    """Return the shapes that a film shows: those of some worlds, their goals, and those that all worlds share."""
    bodies = {-1}.union(*(recording.body_indices(rank) for rank in ranks))
    # names of goals begin with goal_<rank>_ or height_<rank>_
    goals = [shape for shape in goal_shapes(recording) if int(shape.name.split("_")[1]) in ranks]
    return [shape for shape in recording.shapes if shape.body in bodies] + goals


def _interpolated(recording: Recording, values: np.ndarray, times: np.ndarray) -> np.ndarray:
    """Interpolate one value per recorded frame, (num_frames, ...), to times [s]; return (times, ...)."""
    columns = [np.interp(times, recording.times, column) for column in values.reshape(len(values), -1).T]
    return np.stack(columns, axis=1).reshape(len(times), *values.shape[1:])


def drawn_poses(recording: Recording, times: np.ndarray) -> np.ndarray:
    """Return the bodies' poses in a film, (times, bodies, 7), interpolated to times [s].

    Position [m] and quaternion xyzw, world frame; worlds are spaced apart along y. A quaternion and its negative are
    the same rotation: the nearer one is the end of the linear interpolation, which is then normalised.
    """
    after = np.clip(np.searchsorted(recording.times, times), 1, max(1, len(recording.times) - 1))
    after = np.minimum(after, len(recording.times) - 1)
    before = np.maximum(after - 1, 0)
    span = np.maximum(recording.times[after] - recording.times[before], 1.0e-9)
    weight = np.clip((times - recording.times[before]) / span, 0.0, 1.0)[:, None, None]
    start = recording.poses[before].astype(float)
    end = recording.poses[after].astype(float)
    sign = np.where((start[..., 3:] * end[..., 3:]).sum(axis=-1, keepdims=True) < 0.0, -1.0, 1.0)
    end[..., 3:] *= sign
    poses = start + weight * (end - start)
    poses[..., 3:] /= np.linalg.norm(poses[..., 3:], axis=-1, keepdims=True)
    rank = {f"world_{world}": rank for rank, world in enumerate(recording.worlds)}
    poses[..., 1] += recording.spacing * np.array([rank[body.split("/")[0]] for body in recording.bodies])
    return poses


def _view(
    paths: np.ndarray, size: tuple[int, int], eye: Sequence[float] | None, field_of_view: float = FIELD_OF_VIEW
) -> View:
    """Return the camera's view relative to its target: from `eye`, or one that always shows all robots.

    paths: base positions relative to the target [m], (num_frames, worlds, 3).
    """
    if eye is not None:
        return View(np.asarray(eye, dtype=float), np.zeros(3), field_of_view)
    return scene.fit(scene.corners(paths), np.array(DIRECTION), size, field_of_view)


def _lines(recording: Recording, paths: np.ndarray, bases: np.ndarray, frame: int, ranks: Sequence[int]) -> list[Line]:
    """Return the lines that an image shows: recent paths of base and paws, arrows of commanded and actual velocity.

    paths: base positions as drawn [m], (num_frames, worlds, 3); bases: at the image's time [m], (worlds, 3).
    """
    first = int(np.searchsorted(recording.times, recording.times[frame] - TRAIL_SECONDS))
    lines = []
    for rank, path, base in zip(ranks, np.moveaxis(paths, 1, 0), bases, strict=True):
        paws = recording.contact_points[first : frame + 1, rank] + [0.0, recording.spacing * rank, 0.0]
        if frame > first:
            lines.append(Line(path[first : frame + 1], BASE_COLOR))
            lines += [Line(paws[:, leg], color) for leg, color in enumerate(LEG_COLORS.values()) if leg < paws.shape[1]]
        lines += scene.velocity_arrows(recording, frame, rank, base + [0.0, 0.0, 0.3])
    return lines


def _encode_mp4(path: Path, target: Path, images: Iterator[Image.Image], size: tuple[int, int], fps: float) -> None:
    """Write images as H.264 in yuv420p, for browsers and slides. Raises OSError, about `target`: ffmpeg fails."""
    from imageio_ffmpeg import get_ffmpeg_exe

    source = ["-f", "rawvideo", "-pix_fmt", "rgb24", "-s", f"{size[0]}x{size[1]}", "-r", str(fps), "-i", "-"]
    coding = ["-c:v", "libx264", "-pix_fmt", "yuv420p", "-crf", "20", "-movflags", "+faststart"]
    command = [get_ffmpeg_exe(), "-y", "-v", "error", *source, *coding, str(path)]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stderr=subprocess.PIPE) as ffmpeg:
        assert ffmpeg.stdin is not None
        with suppress(BrokenPipeError):  # the exit status and message follow
            for image in images:
                ffmpeg.stdin.write(image.tobytes())
        message = ffmpeg.communicate()[1].decode(errors="replace")
    if ffmpeg.returncode:
        reason = f"ffmpeg failed with status {ffmpeg.returncode}: {' '.join(message.split())[-300:]}"
        raise OSError(errno.EIO, reason, str(target))


def _encoded_animation(images: Iterator[Image.Image], kind: str, fps: float, count: int) -> bytes:
    """Return `count` images as the content of a file with a repeating animation; kind: webp or gif.

    Durations are differences of rounded times, so that rounding errors do not add up.
    """
    pictures = list(images)
    data = io.BytesIO()
    tick = 10 if kind == "gif" else 1  # [ms] unit of the durations in the file
    ends = tick * np.round(1000.0 / fps / tick * np.arange(count + 1)).astype(int)
    durations = np.diff(ends).tolist()  # [ms]
    options: Json = {"quality": 75, "method": 4} if kind == "webp" else {"optimize": True}
    pictures[0].save(data, kind, save_all=True, append_images=pictures[1:], duration=durations, loop=0, **options)
    return data.getvalue()
