"""Export of recordings as files of the Rerun viewer: `rerun FILE.rrd` shows them.

Entities, where <world> is the label of a world, or `world_<i>` if two worlds have the same label:
    scene/<shape>                       ground, goals, and other shapes that are fixed to the world
    scene/<world>/<link>                pose of a link over time
    scene/<world>/<link>/<shape>
    scene/<world>/trail                 paths of the base and of the contact points
    scene/<world>/contact_forces
    scene/<world>/commanded_velocity, actual_velocity
    scene/view_target                   point that the camera follows
    series/<group>/<quantity [unit]>    one curve, or one for each leg in the order of LEG_COLORS
    states/<quantity>/<world>           state, as text, over time

No viewer is started and no port is opened.
"""

import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from jumper_warp.utils.checks import check_type
from jumper_warp.utils.files import write_atomically
from jumper_warp.utils.rotations import turn_plane, yaw_of
from jumper_warp.viz.props import goal_shapes
from jumper_warp.viz.recording import Recording
from jumper_warp.viz.style import ACTUAL_COLOR, COMMAND_COLOR, LEG_COLORS

TIMELINE = "time"  # name of the only timeline; durations [s]
FORCE_SCALE = 1.0e-3  # [m/N] length of a contact arrow over its force
VELOCITY_SCALE = 0.5  # [s] length of a velocity arrow over the velocity
VELOCITY_LIFTS = (0.22, 0.27)  # [m] height of the arrows of commanded and of actual velocity above the base
ARROW_RADIUS = 0.006  # [m]
TRAIL_WIDTH = 1.5  # [px]
LINE_WIDTHS = (1.0, 2.0)  # [px] of commanded and of all other curves
EYE_DIRECTION = np.array([0.70, 0.63, 0.336])  # from the target of the view to the eye, world frame; a unit vector
EYE_DISTANCE = 1.8  # [m] smallest distance of the eye from its target
PLAIN = 3  # Groups of series that are always visible; others are in tabs
LEGEND_SHARE = 0.35  # free time axis behind the curves, where the legend is, over the recording's length
LEG_QUANTITY = re.compile(rf"({'|'.join(LEG_COLORS)})(?:_(\w+))? (\[.+\])")
"""Pattern of the name of a quantity of one leg: leg, motor if any, unit in brackets."""


def write_rrd(recording: Recording, path: Path) -> Path:
    """Write a recording atomically as a Rerun file (.rrd); return the path.

    Rerun collects it in memory: on a full disk its own writer would wait for ever.
    Raises OSError.
    """
    check_type("recording", recording, Recording)
    stream = rr.RecordingStream("jumper-warp")
    memory = stream.memory_recording()
    stream.send_blueprint(blueprint(recording), make_active=False, make_default=True)
    RecordingWriter(stream, recording).write()
    write_atomically(Path(path), memory.drain_as_bytes())
    return Path(path)


class RecordingWriter:
    """Writer of one recording to a Rerun stream, with one call for all frames of an entity."""

    def __init__(self, stream: Any, recording: Recording, *, static: bool = True, first: int = 0) -> None:
        """Prepare to write a recording; stream: a `rerun.RecordingStream`.

        static: whether to write what does not change over time. first: first frame to write.
        """
        self.stream = stream
        self.recording = recording
        self.static = static
        self.first = first
        self.worlds = _world_names(recording)

    def write(self) -> None:
        """Write scene, worlds, series and states."""
        self.log_scene()
        for rank in range(len(self.recording.worlds)):
            self.log_world(rank)
        self.log_series()
        self.log_states()

    def log_scene(self) -> None:
        """Log the scene: all shapes once, and over time the poses of all bodies and the camera's target."""
        recording = self.recording
        parents = []
        for body in recording.bodies:
            world, link = body.split("/")
            parents.append(["scene", self.worlds[recording.worlds.index(int(world.removeprefix("world_")))], link])
        self._log(["scene"], rr.ViewCoordinates.RIGHT_HAND_Z_UP)
        for shape in (*recording.shapes, *goal_shapes(recording)):
            parent = ["scene"] if shape.body < 0 else parents[shape.body]
            mesh = rr.Mesh3D(
                vertex_positions=shape.vertices,
                vertex_normals=shape.normals,
                triangle_indices=shape.triangles,
                albedo_factor=[*_rgb([shape.color])[0], 255],
            )
            self._log([*parent, shape.name], mesh)
        for index, parent in enumerate(parents):
            pos, quat = np.split(recording.poses[self.first :, index], [3], axis=1)
            self._send(parent, rr.Transform3D.columns(translation=pos, quaternion=quat))
        # The viewer puts the eye at 1.5 times the radius of the tracked entity: an invisible one, without area, sets it
        target, distance = view_targets(recording)
        ends = np.outer([-1.0, 1.0], [distance / 1.5, 0.0, 0.0])
        flat = rr.Mesh3D(vertex_positions=ends, triangle_indices=[[0, 0, 1]])
        self._log(["scene", "view_target"], flat)
        self._send(["scene", "view_target"], rr.Transform3D.columns(translation=target[self.first :]))

    def log_world(self, rank: int) -> None:
        """Log position, trail, contact forces and velocities of the rank-th recorded world."""
        recording = self.recording
        parent = ["scene", self.worlds[rank]]
        self._log(parent, rr.Transform3D(translation=[0.0, rank * recording.spacing, 0.0]))
        points = recording.contact_points[:, rank]
        base = recording.body_poses(rank)[:, 0]
        colors = list(LEG_COLORS.values())  # four contact points are the paws
        colors = colors if points.shape[1] == len(colors) else [ACTUAL_COLOR] * points.shape[1]
        strips = [base[:, :3], *points.transpose(1, 0, 2)]
        trail = rr.LineStrips3D(
            [strip[np.isfinite(strip).all(axis=1)] for strip in strips],
            colors=_rgb([ACTUAL_COLOR, *colors]),
            radii=rr.Radius.ui_points(0.5 * TRAIL_WIDTH),
        )
        self._log([*parent, "trail"], trail)
        if len(colors):
            self._log_arrows(
                [*parent, "contact_forces"], points, FORCE_SCALE * recording.contact_forces[:, rank], colors
            )
        if len(recording.commands):
            arrows = zip(("commanded", "actual"), velocities(recording, rank), VELOCITY_LIFTS, strict=True)
            for name, values, lift in arrows:
                color = COMMAND_COLOR if name == "commanded" else ACTUAL_COLOR
                origin = base[:, None, :3] + (0.0, 0.0, lift)
                self._log_arrows([*parent, f"{name}_velocity"], origin, VELOCITY_SCALE * values[:, None], [color])

    def _log_arrows(
        self, entity: list[str], origins: np.ndarray, vectors: np.ndarray, colors: Iterable[tuple[float, float, float]]
    ) -> None:
        """Log the same number of arrows in each frame; origins, vectors [m]: (frames, arrows, 3)."""
        style = rr.Arrows3D.from_fields(radii=ARROW_RADIUS, colors=_rgb(colors))
        self._log(entity, style)
        origins = origins[self.first :]
        vectors = vectors[self.first :]
        columns = rr.Arrows3D.columns(origins=origins.reshape(-1, 3), vectors=vectors.reshape(-1, 3))
        self._send(entity, columns.partition([origins.shape[1]] * len(origins)))

    def log_series(self) -> None:
        """Log each plot of the recording as scalars over time."""
        for plot in (plot for plots in _plots(self.recording).values() for plot in plots):
            style = rr.SeriesLines(names=plot.names, colors=_rgb(plot.colors), widths=[plot.width] * len(plot.names))
            self._log(plot.entity, style)
            self._send(plot.entity, rr.Scalars.columns(scalars=plot.values[self.first :]))

    def log_states(self) -> None:
        """Log the states, as text, in the frames in which they change."""
        for name, words in self.recording.states.items():
            frames = range(self.first, len(words))
            changes = [i for i in frames if i == self.first or words[i] != words[i - 1]]
            columns = rr.StateChange.columns(state=[words[i] for i in changes])
            self._send(["states", *name.split("/", 1)], columns, changes)

    def _log(self, entity: list[str], archetype: Any) -> None:
        """Log what does not change over time."""
        if self.static:
            self.stream.log(rr.new_entity_path(entity), archetype, static=True)

    def _send(self, entity: list[str], columns: Any, frames: Sequence[int] | None = None) -> None:
        """Log an entity's values, one for each of some frames (default: all from the first one on)."""
        frames = range(self.first, len(self.recording.times)) if frames is None else frames
        if len(frames):
            times = [rr.TimeColumn(TIMELINE, duration=self.recording.times[list(frames)])]
            self.stream.send_columns(rr.new_entity_path(entity), times, columns)


def _world_names(recording: Recording) -> list[str]:
    """Return distinct names of the recorded worlds for entity paths: two worlds in one entity would overwrite."""
    labels = [recording.label(rank) for rank in range(len(recording.worlds))]
    return labels if len(set(labels)) == len(labels) else [f"world_{world}" for world in recording.worlds]


def _rgb(colors: Iterable[tuple[float, float, float]]) -> np.ndarray:
    """Convert colors (n, 3) in [0, 1] to bytes."""
    return np.round(255.0 * np.clip(list(colors), 0.0, 1.0)).astype(np.uint8)


def velocities(recording: Recording, rank: int) -> tuple[np.ndarray, np.ndarray]:
    """Return commanded and actual horizontal velocity [m/s] of a world's base, world axes, (frames, 3) each.

    Commands are turned by the base's yaw; NaN is replaced by 0. Actual: central differences of the base's origin.
    """
    base = recording.body_poses(rank)[:, 0].astype(float)
    commanded = turn_plane(recording.commands[:, rank, :2], yaw_of(base[:, 3:]))
    moves = len(base) > 1
    actual = np.gradient(base[:, :2], recording.times, axis=0) if moves else np.zeros_like(base[:, :2])
    commanded, actual = (np.pad(np.nan_to_num(values), ((0, 0), (0, 1))) for values in (commanded, actual))
    return commanded, actual


def view_targets(recording: Recording) -> tuple[np.ndarray, float]:
    """Return the camera's target [m], world frame, (frames, 3), and the camera's distance from it [m].

    The target follows the mean horizontal position of the worlds' bases, at the mean of their extreme heights.
    """
    count = len(recording.worlds)
    base = np.stack([recording.body_poses(rank)[:, 0, :3] for rank in range(count)], axis=1).astype(float)
    base[..., 1] += recording.spacing * np.arange(count)
    base = np.where(np.isfinite(base), base, 0.0)
    target = base.mean(axis=1)
    low = base[..., 2].min()
    high = base[..., 2].max()
    target[:, 2] = 0.5 * (low + high)
    spread = np.linalg.norm((base - target[:, None])[..., :2], axis=2).max()
    return target, max(EYE_DISTANCE, 2.4 * (high - low)) + 1.3 * spread


@dataclass(frozen=True)
class _Plot:
    """One plot of the Rerun viewer: the curves that belong to one entity."""

    group: str  # of the series
    title: str  # `quantity [unit]`
    names: list[str]  # of the curves, for the legend
    colors: list[tuple[float, float, float]]  # of the curves
    width: float  # [px] of the curves
    values: np.ndarray  # (frames, curves)
    by_leg: bool  # whether there is one curve for each leg

    @property
    def entity(self) -> list[str]:
        """Path of the plot's entity, as a list of its parts."""
        return ["series", self.group, self.title]


def _plots(recording: Recording) -> dict[str, list[_Plot]]:
    """Return the plots of the series by group; one plot shows the same motor of all legs, or all paws.

    Curves are in the order of legs. Their colors are those of the leg, of the world if there are several, or else
    those of commanded and actual quantities.
    """
    plots: dict[str, list[_Plot]] = {}
    legs: dict[tuple[str, str], dict[str, np.ndarray]] = {}  # by group and title, then by leg
    for name, values in recording.series.items():
        group, quantity = name.split("/", 1)
        plots.setdefault(group, [])
        if match := LEG_QUANTITY.fullmatch(quantity):
            leg, motor, unit = match.groups()
            legs.setdefault((group, f"{motor or 'paws'} {unit}"), {})[leg] = values
        else:
            plots[group].append(_curve(recording, group, quantity, values))
    for (group, title), by_leg in legs.items():
        order = [leg for leg in LEG_COLORS if leg in by_leg]
        values = np.stack([by_leg[leg] for leg in order], axis=1)
        colors = [LEG_COLORS[leg] for leg in order]
        plots[group].append(_Plot(group, title, order, colors, LINE_WIDTHS[1], values, True))
    return plots


def _curve(recording: Recording, group: str, quantity: str, values: np.ndarray) -> _Plot:
    """Return the plot of one series, values (frames,); its legend omits the label of the only world."""
    commanded = quantity.startswith("command")
    color = COMMAND_COLOR if commanded else ACTUAL_COLOR
    label = quantity
    worlds = _world_names(recording)
    for rank, world in enumerate(worlds):
        if f", {world} [" in quantity:
            several = len(worlds) > 1
            color = list(LEG_COLORS.values())[rank % len(LEG_COLORS)] if several else color
            label = quantity if several else quantity.replace(f", {world} [", " [")
    return _Plot(group, quantity, [label], [color], LINE_WIDTHS[0 if commanded else 1], values[:, None], False)


def blueprint(
    recording: Recording, seconds: float = 0.0, play_state: Literal["playing", "following"] = "playing"
) -> Any:
    """Return the Rerun viewer's layout: scene and states on the left, plots on the right, motors in tabs.

    The viewer plays in a loop from the beginning, with all panels collapsed. seconds: end of the time axis [s]
    (default: the recording's). play_state: Rerun's, "following" for a recording that grows.
    """
    start = float(recording.times[0])
    end = max(float(recording.times[-1]), seconds)
    limits = (rrb.TimeRangeBoundary.absolute(seconds=t) for t in (start, end + LEGEND_SHARE * (end - start)))
    axis = rrb.TimeAxis(view_range=rr.TimeRange(*limits))
    left = [_scene_view(recording)]
    shares = [1.0]
    if recording.states:
        left.append(rrb.StateTimelineView(origin="/states", name="states", time_view=axis))
        shares.append(0.08 + 0.06 * len(recording.states))
    columns: list[Any] = [rrb.Vertical(*left, row_shares=shares)]
    groups = {group: _group_views(group, plots, axis) for group, plots in _plots(recording).items()}
    plain = [views[0] for views in groups.values() if len(views) == 1]
    tabs = [rrb.Vertical(*views, name=group) for group, views in groups.items() if len(views) > 1]
    tabs += plain[PLAIN:]
    plain = plain[:PLAIN]
    if groups:
        shares = [1.0] * len(plain) + [3.0] * bool(tabs)
        columns.append(rrb.Vertical(*plain, *([rrb.Tabs(*tabs)] if tabs else []), row_shares=shares))
    panel = rrb.TimePanel(timeline=TIMELINE, state="collapsed", play_state=play_state, loop_mode="all")
    layout = rrb.Horizontal(*columns, column_shares=[3, 2][: len(columns)])
    return rrb.Blueprint(layout, panel, rrb.BlueprintPanel(state="collapsed"), rrb.SelectionPanel(state="collapsed"))


def _group_views(group: str, plots: list[_Plot], axis: Any) -> list[Any]:
    """Return the viewer's plots of a group of series, one per motor or one for the whole group.

    axis: Rerun's time axis.
    Legends are in the free part of the time axis; of the motors' views only the first has one.
    """
    by_motor = len(plots) > 1 and all(plot.by_leg for plot in plots)
    return [
        rrb.TimeSeriesView(
            origin=rr.new_entity_path(plot.entity if by_motor else ["series", group]),
            name=f"{group} {plot.title.removeprefix('paws ')}" if plot.by_leg else group,
            axis_x=axis,
            plot_legend=rrb.PlotLegend(rrb.Corner2D.RightTop, visible=number == 0),
        )
        for number, plot in enumerate(plots if by_motor else plots[:1])
    ]


def _scene_view(recording: Recording) -> Any:
    """Return the view of the scene, whose camera follows `scene/view_target`."""
    targets, distance = view_targets(recording)
    eye = rrb.EyeControls3D(
        position=targets[0] + distance * EYE_DIRECTION,
        look_target=targets[0],
        eye_up=[0.0, 0.0, 1.0],
        tracking_entity="/scene/view_target",
    )
    labels = ", ".join(recording.labels)
    return rrb.Spatial3DView(
        origin="/scene", name=f"scene: {labels}" if labels else "scene", eye_controls=eye, line_grid=False
    )
