"""Composite pictures: one scene with the robot at several times of a recording, and markers of heights and goals."""

from __future__ import annotations

import io
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from jumper_warp.utils.checks import check_flags, check_type
from jumper_warp.utils.errors import InputError
from jumper_warp.utils.files import write_atomically
from jumper_warp.utils.progress import phase
from jumper_warp.viz.props import goal_shapes
from jumper_warp.viz.recording import Recording
from jumper_warp.viz.renderer import Line, View, open_renderer
from jumper_warp.viz.scene import Label, annotate, corners, fit, valid_frames, velocity_arrows
from jumper_warp.viz.shapes import ShapeMesh
from jumper_warp.viz.style import BASE_COLOR, GOAL_COLOR

WIDTH = 1600  # [px] default width
HEIGHTS = (380, 1400)  # [px] least and largest height for that width
ELEVATION = 0.13  # [1] height of the eye over its horizontal distance
FIELD_OF_VIEW = 16.0  # [deg] narrow, so that near and far moments have nearly the same scale
GAP = 0.28  # [m] least distance between the bases of two moments of a jump in the picture
SIDE_BY_SIDE = 0.8  # [m] least distance between two moments of a walk
APART = (0.6, 0.6)  # [m] distance, to the right or up, from which two moments do not hide each other
GHOST = 0.4  # opacity of moments that would hide others
SPREAD = 0.95  # [m] distance between moments of a robot that stays in place
STAYS = 0.6  # [m] horizontal distance up to which the moments are spread, since they would hide each other
DRIFT = 0.15  # [m] horizontal distance up to which the picture shows the x axis; of each hop, up to which a robot stays
TEXT = 0.14  # [m] height of a line of text above a robot
IN_FRONT = 0.7  # [m] distance of the axis of moments of a robot that stays in place from the plane of the picture
RISE = 0.1  # [m] of the base during a flight, above which the flight is a jump
CONTACT = 1.0  # [N] paw force above which a paw touches
MOST = 7  # largest number of moments in a picture
FORMATS = {".png": {}, ".webp": {"quality": 88, "method": 6}, ".jpg": {"quality": 90}}  # Pillow's options by suffix


@dataclass(frozen=True)
class Composition:
    """Content of a composite picture: one robot at several times of a recording, in a vertical plane.

    The plane contains the robot's path.
    """

    recording: Recording
    rank: int  # index in `recording.worlds`
    base: np.ndarray  # (num_frames, 3) [m] base positions, world frame
    right: np.ndarray  # (3,) horizontal unit vector of the path, to the right in the picture
    frames: np.ndarray  # (moments,) indices of the shown frames
    flights: list[tuple[int, int]]  # first and last frame of each flight of a jump
    shift: np.ndarray  # (moments,) [m] offset along `right` of each moment as drawn from its true position

    @property
    def bases(self) -> np.ndarray:
        """Base positions in the picture [m], one for each drawn time, (moments, 3)."""
        return self.base[self.frames] + self.shift[:, None] * self.right

    @property
    def stays(self) -> bool:
        """Whether the robot stays in place, so that its drawings are side by side in order of time, not to scale."""
        return bool(self.shift.any())

    @property
    def heights(self) -> np.ndarray:
        """Commanded base heights of the recorded jump [m], (n,), at most one."""
        heights = self.recording.heights[self.rank : self.rank + 1]
        return heights[np.isfinite(heights)]

    @property
    def grounded(self) -> bool:
        """Whether a paw touches the ground in the recording."""
        return bool((np.linalg.norm(self.recording.contact_forces[:, self.rank], axis=-1) > CONTACT).any())

    @property
    def lowest(self) -> float:
        """Lowest height of a paw in the recording [m]; 0 if no paws are recorded."""
        points = self.recording.contact_points[:, self.rank, :, 2]
        return float(points.min()) if points.size else 0.0

    @property
    def toward_eye(self) -> np.ndarray:
        """Horizontal unit vector from the robot's path to the camera, (3,)."""
        return np.array([self.right[1], -self.right[0], 0.0])

    def span(self) -> tuple[float, float]:
        """Return the left and right end [m] of the picture's content, along its horizontal axis."""
        along = corners(self.bases) @ self.right
        label = 0.75 if self.stays and len(self.heights) else 0.0  # right of the last robot
        return float(along.min()) - 0.15, float(along.max()) + 0.15 + label

    def point(self, along: float, height: float, in_front: float = 0.0) -> np.ndarray:
        """Return the position (3,) [m] in the world of a point in the picture's vertical plane, through the first base.

        along: distance to the right of the world's origin [m]; height: world z [m]; in_front: of the plane and of all
        drawn robots [m], if not 0.
        """
        depths = (self.base[self.frames] if in_front else self.base[:1]) @ self.toward_eye
        depth = depths.max() + in_front
        return along * self.right + depth * self.toward_eye + [0.0, 0.0, height]


def compose(
    recording: Recording, rank: int = 0, eye: Sequence[float] | None = None, true_scale: bool = False
) -> Composition:
    """Choose the times of a recording at which a composite picture shows the robot of the rank-th world.

    The moments of a robot that moves by less than STAYS, or DRIFT a hop, across the picture are drawn spread to the
    right, unless it has a goal farther than GAP from its start. eye, true_scale: as in `write_picture`. Frames after
    `valid_frames` are ignored. Raises InputError: no frame remains.
    """
    count = valid_frames(recording, rank)
    if count == 0:
        raise InputError(f"{recording.label(rank)}: no picture, the poses of the first frame are not finite")
    fields = ("times", "poses", "contact_points", "contact_forces", "commands")
    recording = replace(recording, **{name: getattr(recording, name)[:count] for name in fields})
    base = recording.body_poses(rank)[:, 0, :3].astype(float)
    goals = recording.goals[rank, :, :2] if len(recording.goals) else np.zeros((0, 2))
    offsets = np.concatenate([base[-1:, :2], goals]) - base[0, :2]
    displacement = offsets[0]
    distance = float(np.linalg.norm(displacement))
    flights = _flights(recording, rank)
    across = None if eye is None else np.array([-eye[1], eye[0], 0.0]) / np.hypot(eye[0], eye[1])
    widths = np.linalg.norm(offsets, axis=1) if across is None else np.abs(offsets @ across[:2])
    stays = not true_scale and bool(widths[0] < max(STAYS, DRIFT * len(flights)) and not (widths[1:] > GAP).any())
    right = np.array([1.0, 0.0, 0.0]) if distance < DRIFT else np.append(displacement / distance, 0.0)
    if stays and across is not None:
        right = across
    if not stays and flights:
        frames = _distinct(base @ np.stack([right, [0.0, 0.0, 1.0]], axis=1), flights)
    elif not stays:
        frames = _evenly_moved(base[:, None], int(np.clip(distance / SIDE_BY_SIDE + 1.0, 2.0, MOST)))
    elif flights:
        frames = _events(base[:, 2], flights)
    else:
        frames = _evenly_moved(recording.body_poses(rank), 6)
    frames = np.unique(frames)
    shift = SPREAD * (np.arange(len(frames)) - 0.5 * (len(frames) - 1)) if stays else np.zeros(len(frames))
    return Composition(recording, rank, base, right, frames, flights, shift)


def _flights(recording: Recording, rank: int) -> list[tuple[int, int]]:
    """Return (first, last) frame of every flight of a world in which the base rises by RISE, in order.

    A walk may also have short moments without contact, in which the base hardly rises.
    """
    height = recording.body_poses(rank)[:, 0, 2]
    free = ~(np.linalg.norm(recording.contact_forces[:, rank], axis=-1) > CONTACT).any(axis=-1)
    edges = np.flatnonzero(np.diff(np.concatenate([[False], free, [False]]).astype(int)))
    runs = [(int(first), int(last) - 1) for first, last in edges.reshape(-1, 2)]
    return [(first, last) for first, last in runs if height[first : last + 1].max() - height[first] > RISE]


def _events(height: np.ndarray, flights: list[tuple[int, int]]) -> np.ndarray:
    """Return the frames that show a jump in place: squat, takeoff, rise, apex, fall, touchdown, rest.

    Of several jumps: takeoff, apex and touchdown of the first, apexes spread over the others, and the end.
    """
    apexes = [first + int(np.argmax(height[first : last + 1])) for first, last in flights]
    (takeoff, touchdown), apex = flights[0], apexes[0]
    if len(flights) > 1:
        return np.array([takeoff, apex, touchdown, *_spread(apexes[1:], MOST - 4), len(height) - 1])
    squat = int(np.argmin(height[: takeoff + 1]))
    return np.array([squat, takeoff, (takeoff + apex) // 2, apex, (apex + touchdown) // 2, touchdown, len(height) - 1])


def _spread(frames: list[int], count: int) -> list[int]:
    """Return at most `count` of the given frames, evenly spread over them."""
    return [frames[i] for i in np.unique(np.linspace(0, len(frames) - 1, count).round().astype(int))]


def _distinct(places: np.ndarray, flights: list[tuple[int, int]]) -> np.ndarray:
    """Choose up to MOST frames of a recording, at least GAP apart in the picture, those of important events first.

    Order: apexes, end, start, touchdowns, takeoffs; then the frame that is farthest from the chosen ones, to fill gaps.
    places: base positions in the picture [m], (num_frames, 2), to the right and up.
    """
    apexes = [first + int(np.argmax(places[first : last + 1, 1])) for first, last in flights]
    takeoffs, touchdowns = zip(*flights, strict=True)
    wanted = [*_spread(apexes, MOST - 2), len(places) - 1, 0, *touchdowns, *takeoffs]
    chosen: list[int] = []
    while len(chosen) < MOST:
        distance = np.full(len(places), np.inf)
        for frame in chosen:
            distance = np.minimum(distance, np.linalg.norm(places - places[frame], axis=1))
        wanted = [frame for frame in wanted if distance[frame] >= GAP]
        farthest = int(np.argmax(distance))
        if not wanted and distance[farthest] < GAP:
            break
        chosen.append(wanted.pop(0) if wanted else farthest)
    return np.array(sorted(chosen))


def _evenly_moved(poses: np.ndarray, count: int) -> np.ndarray:
    """Choose `count` frames between which the bodies move equally far; poses: (num_frames, bodies, 3 or more).

    The last of them lies just before the end of the motion, since the robot may rest for long after it.
    """
    steps = np.linalg.norm(np.diff(poses[..., :3], axis=0), axis=-1).sum(axis=1)
    moved = np.concatenate([[0.0], np.cumsum(steps)])
    return np.searchsorted(moved, np.linspace(0.0, 0.99 * moved[-1], count))


def write_picture(
    recording: Recording,
    path: Path,
    *,
    rank: int = 0,
    width: int = WIDTH,
    eye: Sequence[float] | None = None,
    title: str | None = None,
    true_scale: bool = False,
    field_of_view: float = FIELD_OF_VIEW,
) -> Path:
    """Write a composite picture (.png, .webp or .jpg) of one world of a recording; return its path.

    rank: index in `recording.worlds`. width: of the picture [px]; its height depends on the motion. eye: direction of
    the camera from the robot, world frame, of any length (default: from the right of the path). title: default: task
    and name of the world. true_scale: draw all moments at their true places, also of a robot that stays in place, where
    they hide each other. field_of_view: vertical angle of view [deg]; a larger one shows more perspective.
    Raises InputError: another suffix, width or angle, or a vertical view; OSError.
    """
    check_type("recording", recording, Recording)
    path = Path(path)
    check_type("width", width, int)
    check_type("title", title, str | None)
    check_flags(true_scale=true_scale)
    if path.suffix not in FORMATS or not 200 <= width <= 8000:
        raise InputError(f"{path}: a picture needs suffix {', '.join(FORMATS)} and width 200 to 8000 px, got {width}")
    View(np.array([1.0, 0.0, 0.0]) if eye is None else np.asarray(eye), np.zeros(3), field_of_view).axes()
    scene = compose(recording, rank, eye, true_scale)
    direction = scene.toward_eye + [0.0, 0.0, ELEVATION] if eye is None else np.array(eye, dtype=float)
    view, size = _framed(_extent(scene), direction, width, field_of_view)
    poses = recording.body_poses(rank)[scene.frames].astype(float)
    poses[..., :3] += scene.shift[:, None, None] * scene.right
    with (
        open_renderer(_shapes(scene), poses.shape[1], size, _opacity(scene).tolist()) as renderer,
        phase(f"drawing {path.name} with {renderer.name}"),
    ):
        image = renderer.draw(poses, view, _lines(scene))
    heading = recording.heading([rank]) if title is None else title
    data = io.BytesIO()
    options = FORMATS[path.suffix]
    annotate(image, view, _labels(scene), heading, 0.0145 * width / size[1]).save(
        data, path.suffix[1:].replace("jpg", "jpeg"), **options
    )
    path.parent.mkdir(parents=True, exist_ok=True)
    write_atomically(path, data.getvalue())
    return path


def _opacity(scene: Composition) -> np.ndarray:
    """Return the robot's opacity at each drawn time, (moments,): GHOST where it would hide another, else 1.

    Only less important times get GHOST.
    Apexes, start and end are the most important.
    """
    places = np.stack([scene.bases @ scene.right, scene.bases[:, 2]], axis=1)
    apexes = [first + int(np.argmax(scene.base[first : last + 1, 2])) for first, last in scene.flights]
    first = scene.frames[0]
    last = scene.frames[-1]
    rank = [0 if frame in apexes else 1 if frame in (first, last) else 2 for frame in scene.frames]
    opacity = np.full(len(places), GHOST)
    for i in sorted(range(len(places)), key=lambda i: rank[i]):
        hidden = (np.abs(places[opacity == 1.0] - places[i]) < APART).all(axis=1).any()
        opacity[i] = GHOST if hidden and rank[i] > 0 else 1.0
    return opacity


def _extent(scene: Composition) -> np.ndarray:
    """Return the points that the picture must show, (n, 3) [m], world frame: robots with labels, scale and bars."""
    low, high = scene.span()
    ground = scene.lowest - 0.1
    heights = [*scene.heights, *([ground] if scene.grounded else [])]
    scale = low - max(0.25, 0.08 * (high - low))  # the numbers of the scale are left of `low`
    frame = [scene.point(along, height) for along in (scale, high) for height in heights]
    goals = scene.recording.goals[scene.rank] if len(scene.recording.goals) and not scene.stays else np.zeros((0, 3))
    boxes = corners(scene.bases, ground)
    if scene.stays:
        ends = (low + 0.1 - 0.08 * (high - low), high)  # the label of the axis is left of `low`
        goals = np.array([scene.point(along, ground - 0.1, IN_FRONT) for along in ends])
    return np.concatenate(
        [boxes, boxes + [0.0, 0.0, 0.2], np.reshape(frame, (-1, 3)), goals[np.isfinite(goals).all(axis=1)]]
    )


def _framed(
    points: np.ndarray, direction: np.ndarray, width: int, field_of_view: float
) -> tuple[View, tuple[int, int]]:
    """Return the view from a direction that shows all points, and the image size [px], as high as necessary.

    A first view in the highest image measures how high the content is.
    """
    size = (width, HEIGHTS[1] * width // WIDTH)
    pixels = fit(points, direction, size, field_of_view).project(points, size)
    needed = float(np.ptp(pixels[:, 1]) / np.ptp(pixels[:, 0])) * width
    least, most = (limit * width // WIDTH for limit in HEIGHTS)
    height = min(max(round(needed + 0.04 * width), least), most)
    size = (width, height + height % 2)
    return fit(points, direction, size, field_of_view), size


def _shapes(scene: Composition) -> list[ShapeMesh]:
    """Return the shapes to draw: robot, ground, and rings at the goals if the robot is at its true position."""
    own = {body: i for i, body in enumerate(scene.recording.body_indices(scene.rank))} | {-1: -1}
    shapes = [replace(shape, body=own[shape.body]) for shape in scene.recording.shapes if shape.body in own]
    if scene.stays:
        return shapes
    moved = replace(scene.recording, spacing=0.0, heights=np.zeros(0))
    return shapes + [shape for shape in goal_shapes(moved) if shape.name.startswith(f"goal_{scene.rank}_")]


def _lines(scene: Composition) -> list[Line]:
    """Return the lines to draw: path of the base or axis of moments, bars at commanded heights, scale of height."""
    low, high = scene.span()
    first = scene.frames[0]
    last = scene.frames[-1]
    if scene.stays:
        axis = [[(low, 0.0), (high, 0.0)]]  # no arrow: it would suggest an even scale
        axis += [[(along, 0.03), (along, 0.0)] for along in scene.bases @ scene.right]
        paths = [np.stack([scene.point(x, scene.lowest + z, IN_FRONT) for x, z in path]) for path in axis]
        lines = [Line(path, BASE_COLOR) for path in paths]
    else:
        lines = [Line(scene.base[first : last + 1], BASE_COLOR)]
    lines += [Line(np.stack([scene.point(low, z), scene.point(high, z)]), GOAL_COLOR) for z in scene.heights]
    ticks = _ticks(scene)
    if len(ticks):
        lines.append(Line(np.stack([scene.point(low, 0.0), scene.point(low, ticks[-1])]), BASE_COLOR))
    lines += [Line(np.stack([scene.point(low - 0.03, z), scene.point(low + 0.03, z)]), BASE_COLOR) for z in ticks]
    for frame, base in zip(scene.frames, scene.bases, strict=True):
        lines += velocity_arrows(scene.recording, int(frame), scene.rank, base + [0.0, 0.0, 0.2])
    return lines


def _ticks(scene: Composition) -> np.ndarray:
    """Return the heights [m] at which the picture's scale has marks: every 0.25 m or wider; none without ground."""
    if not scene.grounded:
        return np.zeros(0)
    top = max(float(scene.bases[:, 2].max()), *scene.heights, 0.25)
    step = 0.25 * 2.0 ** max(0.0, np.floor(np.log2(top / 1.5)) + 1.0)
    return np.arange(0.0, top + 0.1, step)


def _labels(scene: Composition) -> list[Label]:
    """Return the labels: time (and base height of a jump) of each drawn robot, numbers of scale and bars.

    Times are above the robots, or on the axis of a robot that stays in place.
    """
    low, high = scene.span()
    jumps = bool(scene.flights)
    labels = []
    for frame, base, opacity in zip(scene.frames, scene.bases, _opacity(scene), strict=True):
        if opacity < 1.0:
            continue
        time = f"{scene.recording.times[frame]:.2f} s"
        height = [f"{base[2]:.2f} m"] if jumps else []
        above = height if scene.stays else [time, *height]
        place = base + [0.0, 0.0, 0.4 if len(scene.recording.commands) else 0.2]
        if jumps:  # above the ghosts near it
            near = np.abs((scene.bases - base) @ scene.right) < GAP
            place[2] += scene.bases[near, 2].max() - base[2]
        if any(place[2] - 0.03 < bar < place[2] + TEXT * len(above) for bar in scene.heights):
            place[2] = scene.heights.max() + 0.03
        labels.append(Label("\n".join(above), place))
        if scene.stays:
            labels.append(Label(time, scene.point(base @ scene.right, scene.lowest - 0.03, IN_FRONT), "ma"))
    if scene.stays:
        labels.append(Label("time, not\nto scale", scene.point(low + 0.1, scene.lowest - 0.03, IN_FRONT), "ra"))
    labels += [Label(f"{z:g} m", scene.point(low - 0.06, z), "rm") for z in _ticks(scene)]
    labels += [Label(f"commanded {z:.2f} m", scene.point(high, z + 0.01), "rd") for z in scene.heights]
    return labels
