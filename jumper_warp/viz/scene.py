"""Camera framing, camera motion that follows robots, and labels in images."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from importlib.util import find_spec
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from jumper_warp.utils.rotations import turn_plane, yaw_of
from jumper_warp.viz.recording import Recording
from jumper_warp.viz.renderer import FIELD_OF_VIEW, Line, View
from jumper_warp.viz.style import ACTUAL_COLOR, COMMAND_COLOR

REACH = 0.45  # [m] half the length and width of a standing robot, with legs
ABOVE = 0.25  # [m] free space above the base
DEAD_ZONE = np.array([0.25, 0.25, 0.20])  # [m] distance of a robot from the target from which the camera follows
SMOOTHING = 0.25  # [s] standard deviation of the filter of the camera's motion
ARROW_SECONDS = 0.6  # [s] length of an arrow over the velocity that it shows
SLOWEST = 0.05  # [m/s] below which no arrow is drawn
VELOCITY_WINDOW = 0.2  # [s] over which the actual velocity is averaged
FAR = 100.0  # [m] from the start, beyond which the simulation of a robot has diverged
MARGIN = 0.94  # fraction of the image that robots may fill


@dataclass(frozen=True)
class Label:
    """Text label at a point of the world."""

    text: str
    point: np.ndarray  # (3,) [m] world frame
    anchor: str = "md"  # Pillow's anchor: middle of the text's bottom at the point


def valid_frames(recording: Recording, rank: int) -> int:
    """Return the number of frames before a world diverges: a pose is not finite, or the base is FAR from its start.

    Later frames are not drawn: the camera would have to show all of them.
    """
    poses = recording.body_poses(rank)
    valid = np.isfinite(poses).all(axis=(1, 2)) & (np.abs(poses[:, 0] - poses[0, 0])[:, :3] < FAR).all(axis=1)
    return int(np.argmin(np.append(valid, False)))


def without_divergence(recording: Recording) -> Recording:
    """Return a copy in which poses and contact points after `valid_frames` are NaN, so that they are not drawn."""
    poses = recording.poses.copy()
    points = recording.contact_points.copy()
    for rank in range(len(recording.worlds)):
        count = valid_frames(recording, rank)
        poses[count:, recording.body_indices(rank)], points[count:, rank] = np.nan, np.nan
    return replace(recording, poses=poses, contact_points=points)


def body_paths(recording: Recording, ranks: Sequence[int]) -> np.ndarray:
    """Return base positions as drawn [m], (num_frames, worlds, 3), world frame; worlds are side by side along y.

    A robot whose simulation diverges keeps its last valid position, or the origin.
    """
    paths = np.stack([recording.body_poses(rank)[:, 0, :3] for rank in ranks], axis=1).astype(float)
    for i, rank in enumerate(ranks):
        count = valid_frames(recording, rank)
        paths[count:, i] = paths[count - 1, i] if count else 0.0
    return paths + recording.spacing * np.array(ranks)[:, None] * np.array([0.0, 1.0, 0.0])


def corners(bases: np.ndarray, ground: float = -np.inf) -> np.ndarray:
    """Return the corners [m], (n, 3), of boxes that enclose robots with base positions (..., 3) and their paws.

    ground [m]: lower bound of the boxes' height.
    """
    half = np.array([REACH, REACH, 0.0])
    signs = np.array([[x, y, 0.0] for x in (-1.0, 1.0) for y in (-1.0, 1.0)])
    flat = bases.reshape(-1, 1, 3) + signs * half
    low = flat - [0.0, 0.0, REACH]
    low[..., 2] = np.maximum(low[..., 2], ground)
    return np.concatenate([flat + [0.0, 0.0, ABOVE], low]).reshape(-1, 3)


def fit(points: np.ndarray, direction: np.ndarray, size: tuple[int, int], field_of_view: float = FIELD_OF_VIEW) -> View:
    """Return the nearest camera view from a direction that shows all points (n, 3) [m], world frame.

    direction: from the target to the eye, (3,), world frame; size: width and height of the image [px].
    """
    target = 0.5 * (points.min(axis=0) + points.max(axis=0))
    unit = direction / np.linalg.norm(direction)
    for _ in range(2):  # then around the middle of the image
        distance = _nearest(points, target, unit, size, field_of_view)
        view = View(target + distance * unit, target, field_of_view)
        pixels = view.project(points, size)
        offset = 0.5 * (pixels.min(axis=0) + pixels.max(axis=0)) - 0.5 * np.array(size)
        scale = 2.0 * distance * np.tan(np.radians(0.5 * field_of_view)) / size[1]  # [m] of a pixel at the target
        right, up, _ = view.axes()
        target = target + scale * (offset[0] * right - offset[1] * up)
    distance = _nearest(points, target, unit, size, field_of_view)
    return View(target + distance * unit, target, field_of_view)


def _nearest(
    points: np.ndarray, target: np.ndarray, unit: np.ndarray, size: tuple[int, int], field_of_view: float
) -> float:
    """Return the least distance [m] from target to eye, along a unit vector, from which all points are in view.

    Found by bisection: the points are in view from every larger distance. size: of the image [px]; field_of_view [deg].
    """
    low = 0.1
    high = 200.0
    for _ in range(40):
        distance = 0.5 * (low + high)
        pixels = View(target + distance * unit, target, field_of_view).project(points, size) / size
        fits = bool((np.abs(pixels - 0.5) <= 0.5 * MARGIN).all())  # false for points behind the eye, NaN
        low, high = (low, distance) if fits else (distance, high)
    return high


def follow(paths: np.ndarray, dt: float) -> np.ndarray:
    """Return the targets of a camera that follows robots with a dead zone, (num_frames, 3) [m], world frame.

    paths: base positions [m], (num_frames, worlds, 3); dt [s]: between frames. The target moves smoothly, and only
    while the robots' mean position is further than DEAD_ZONE from it.
    """
    from scipy.ndimage import gaussian_filter1d  # takes 0.2 s, which a picture does not need

    middle = paths.mean(axis=1)
    target = middle[0]
    targets = []
    for position in middle:
        target = position + np.clip(target - position, -DEAD_ZONE, DEAD_ZONE)
        targets.append(target)
    return gaussian_filter1d(np.array(targets), SMOOTHING / dt, axis=0, mode="nearest")


def velocity_arrows(recording: Recording, frame: int, rank: int, start: np.ndarray) -> list[Line]:
    """Return arrows of a world's commanded and actual horizontal velocity at a point [m], world frame, if any.

    The actual velocity is the mean over VELOCITY_WINDOW, which smooths the sway of the base.
    """
    if not len(recording.commands) or not np.isfinite(recording.commands[frame, rank]).all():
        return []
    poses = recording.poses[:, recording.body_indices(rank)[0]].astype(float)
    commanded = np.append(turn_plane(recording.commands[frame, rank, :2], yaw_of(poses[frame, 3:])), 0.0)
    window = np.abs(recording.times - recording.times[frame]) <= 0.5 * VELOCITY_WINDOW + 1.0e-9
    path = poses[window, :3]
    times = recording.times[window]
    actual = (path[-1] - path[0]) / max(times[-1] - times[0], 1.0e-9) * [1.0, 1.0, 0.0]
    arrows = ((commanded, COMMAND_COLOR, 0.05), (actual, ACTUAL_COLOR, 0.0))
    return [
        Line(np.stack([start, start + ARROW_SECONDS * velocity]) + [0.0, 0.0, above], color, arrow=True)
        for velocity, color, above in arrows
        if np.linalg.norm(velocity) > SLOWEST
    ]


def annotate(
    image: np.ndarray, view: View, labels: Sequence[Label], heading: str = "", size: float = 0.03
) -> Image.Image:
    """Draw labels at their points, and a heading at the upper left, on an image (height, width, 3) uint8; return it.

    size: height of the text relative to the image's height.
    """
    picture = Image.fromarray(image)
    draw = ImageDraw.Draw(picture)
    pixels = max(11, round(size * picture.height))
    font = ImageFont.truetype(str(_font_file()), pixels)
    style = {"font": font, "fill": (30, 32, 36), "stroke_width": max(1, pixels // 9), "stroke_fill": (255, 255, 255)}
    if heading:
        draw.text((pixels, pixels), heading, anchor="la", **style)
    if labels:
        places = view.project(np.array([label.point for label in labels]), picture.size)
        for label, place in zip(labels, places, strict=True):
            if np.isfinite(place).all():
                options = {"font": font, "anchor": label.anchor, "align": "center"}
                box = draw.textbbox(tuple(place), label.text, stroke_width=style["stroke_width"], **options)
                place = place + _shift_inside(np.reshape(box, (2, 2)), picture.size)
                draw.text(tuple(place), label.text, **{**style, **options})
    return picture


def _font_file() -> Path:
    """Return the file of the font that Matplotlib has, without its import, which takes 0.1 s."""
    matplotlib = find_spec("matplotlib")
    assert matplotlib is not None and matplotlib.origin is not None
    return Path(matplotlib.origin).parent / "mpl-data/fonts/ttf/DejaVuSans.ttf"


def _shift_inside(box: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """Return the shift [px] (x, y) that moves a box into an image, zero if it is outside altogether.

    box: least and largest corner [px], (2, 2). size: width and height of the image [px].
    """
    low, high = box
    if (high < 0.0).any() or (low > size).any():
        return np.zeros(2)
    return np.maximum(-low, 0.0) - np.maximum(high - size, 0.0)
