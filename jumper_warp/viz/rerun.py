"""Recordings as files of the Rerun viewer: `rerun FILE.rrd` shows them.

Entities, where <world> is the label of a world, or `world_<i>` if two worlds have the same label:
    scene/<shape>                       ground, goals, and other shapes that are fixed to the world
    scene/<world>/<link>                pose of a link over time
    scene/<world>/<link>/<shape>
    scene/<world>/trail                 paths of the base and of the contact points
    scene/<world>/contact_forces
    scene/<world>/commanded_velocity, actual_velocity
    scene/view_target                   point that the eye follows
    series/<group>/<quantity [unit]>    one curve, or one for each leg in the order of LEG_COLORS
    states/<quantity>/<world>           words over time

No viewer is started and no port is opened.
"""

import os
import re
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Any

import numpy as np

from jumper_warp.viz.props import goal_shapes
from jumper_warp.viz.shapes import ShapeMesh
from jumper_warp.viz.style import ACTUAL_COLOR, COMMAND_COLOR, LEG_COLORS

if TYPE_CHECKING:
    from jumper_warp.viz.recording import Recording

TIMELINE = "time"  # name of the only timeline; durations [s]
FORCE_SCALE = 1.0e-3  # [m/N] length of a contact arrow over its force
VELOCITY_SCALE = 0.5  # [s] length of a velocity arrow over the velocity
VELOCITY_LIFT = 0.25  # [m] height of the velocity arrows above the base
ARROW_RADIUS = 0.006  # [m]
TRAIL_WIDTH = 1.5  # [px]
LINE_WIDTHS = (1.0, 2.0)  # [px] of commanded and of all other curves
EYE_DIRECTION = np.array([0.55, 0.77, 0.32])  # from the target of the view to the eye, world frame; a unit vector
EYE_DISTANCE = 2.2  # [m] smallest distance of the eye from its target
LEGEND_SHARE = 0.3  # free time axis behind the curves, where the legend is, over the recording's length
LEG_QUANTITY = re.compile(rf"({'|'.join(LEG_COLORS)})(?:_(\w+))? (\[.+\])")
"""Pattern of a quantity of one leg: leg, motor if any, unit with brackets."""


def write_rrd(recording: "Recording", path: Path) -> Path:
    """Write a recording atomically as a Rerun file (.rrd); return the path.

    Raises ImportError: rerun-sdk is not installed; OSError.
    """
    rr = _import_rerun()
    temporary = path.with_name(f".{path.name}.{os.getpid()}")
    stream = rr.RecordingStream("jumper-warp")
    writer = _Writer(rr, stream, recording)
    try:
        stream.save(temporary, default_blueprint=_blueprint(recording))
        writer.log_scene()
        for rank in range(len(recording.worlds)):
            writer.log_world(rank)
        writer.log_series()
        writer.log_states()
        stream.disconnect()  # closes the file
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)
    return path


def _import_rerun() -> ModuleType:
    """Return the module rerun. Raises ImportError, with the command that installs it."""
    try:
        import rerun
    except ImportError as error:
        raise ImportError("writing .rrd files needs rerun: pip install rerun-sdk") from error
    return rerun


class _Writer:
    """Writer of one recording to a Rerun stream, with one call for all frames of an entity."""

    def __init__(self, rr: ModuleType, stream: Any, recording: "Recording") -> None:
        """Prepare to write; rr: the module rerun, stream: its `RecordingStream`."""
        self.rr, self.stream, self.recording = rr, stream, recording
        self.worlds = _world_names(recording)
        self.times = [rr.TimeColumn(TIMELINE, duration=recording.times)]

    def log_scene(self) -> None:
        """Log all shapes once, the poses of all bodies, and the target of the eye."""
        rr, recording = self.rr, self.recording
        parents = []
        for body in recording.bodies:
            world, link = body.split("/")
            parents.append(["scene", self.worlds[recording.worlds.index(int(world.removeprefix("world_")))], link])
        self.stream.log("scene", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
        for shape in (*recording.shapes, *goal_shapes(recording)):
            parent = ["scene"] if shape.body < 0 else parents[shape.body]
            self.stream.log(rr.new_entity_path([*parent, shape.name]), _mesh(rr, shape), static=True)
        for index, parent in enumerate(parents):
            pos, quat = np.split(recording.poses[:, index], [3], axis=1)
            self._send(parent, rr.Transform3D.columns(translation=pos, quaternion=quat))
        # The viewer puts the eye at 1.5 times the radius of the tracked entity: an invisible one, without area, sets it
        target, distance = view_targets(recording)
        ends = np.outer([-1.0, 1.0], [distance / 1.5, 0.0, 0.0])
        flat = rr.Mesh3D(vertex_positions=ends, triangle_indices=[[0, 0, 1]])
        self.stream.log("scene/view_target", flat, static=True)
        self._send(["scene", "view_target"], rr.Transform3D.columns(translation=target))

    def log_world(self, rank: int) -> None:
        """Log place, trail, contact forces and velocities of the rank-th recorded world."""
        rr, recording, parent = self.rr, self.recording, ["scene", self.worlds[rank]]
        offset = rr.Transform3D(translation=[0.0, rank * recording.spacing, 0.0])
        self.stream.log(rr.new_entity_path(parent), offset, static=True)
        points, base = recording.contact_points[:, rank], recording.body_poses(rank)[:, 0]
        colors = list(LEG_COLORS.values()) if points.shape[1] == len(LEG_COLORS) else [ACTUAL_COLOR] * points.shape[1]
        strips = [base[:, :3], *points.transpose(1, 0, 2)]
        trail = rr.LineStrips3D(
            [strip[np.isfinite(strip).all(axis=1)] for strip in strips],
            colors=_rgb([ACTUAL_COLOR, *colors]),
            radii=rr.Radius.ui_points(0.5 * TRAIL_WIDTH),
        )
        self.stream.log(rr.new_entity_path([*parent, "trail"]), trail, static=True)
        if len(colors):
            self._log_arrows([*parent, "contact_forces"], points, FORCE_SCALE * recording.contact_forces[:, rank], colors)
        if len(recording.commands):
            origin = base[:, None, :3] + (0.0, 0.0, VELOCITY_LIFT)
            commanded, actual = velocities(recording, rank)
            for name, values, color in (("commanded", commanded, COMMAND_COLOR), ("actual", actual, ACTUAL_COLOR)):
                self._log_arrows([*parent, f"{name}_velocity"], origin, VELOCITY_SCALE * values[:, None], [color])

    def _log_arrows(
        self, entity: list[str], origins: np.ndarray, vectors: np.ndarray, colors: Iterable[tuple[float, float, float]]
    ) -> None:
        """Log the same number of arrows in each frame; origins, vectors [m]: (frames, arrows, 3)."""
        style = self.rr.Arrows3D.from_fields(radii=ARROW_RADIUS, colors=_rgb(colors))
        self.stream.log(self.rr.new_entity_path(entity), style, static=True)
        columns = self.rr.Arrows3D.columns(origins=origins.reshape(-1, 3), vectors=vectors.reshape(-1, 3))
        self._send(entity, columns.partition([origins.shape[1]] * len(origins)))

    def log_series(self) -> None:
        """Log each plot of the recording as scalars over time."""
        for plot in _plots(self.recording):
            style = self.rr.SeriesLines(names=plot.names, colors=_rgb(plot.colors), widths=plot.widths)
            self.stream.log(self.rr.new_entity_path(plot.entity), style, static=True)
            self._send(plot.entity, self.rr.Scalars.columns(scalars=plot.values))

    def log_states(self) -> None:
        """Log the frames in which a state changes."""
        for name, words in self.recording.states.items():
            changes = [i for i, word in enumerate(words) if i == 0 or word != words[i - 1]]
            times = [self.rr.TimeColumn(TIMELINE, duration=self.recording.times[changes])]
            columns = self.rr.StateChange.columns(state=[words[i] for i in changes])
            self.stream.send_columns(self.rr.new_entity_path(["states", *name.split("/", 1)]), times, columns)

    def _send(self, entity: list[str], columns: Any) -> None:
        """Log one value in each frame of the recording."""
        self.stream.send_columns(self.rr.new_entity_path(entity), self.times, columns)


def _world_names(recording: "Recording") -> list[str]:
    """Return distinct names of the recorded worlds for entity paths."""
    labels = [recording.label(rank) for rank in range(len(recording.worlds))]
    return labels if len(set(labels)) == len(labels) else [f"world_{world}" for world in recording.worlds]


def _mesh(rr: ModuleType, shape: ShapeMesh) -> Any:
    """Return a shape as Rerun's mesh, in the body's frame, with an opaque color."""
    return rr.Mesh3D(
        vertex_positions=shape.vertices,
        vertex_normals=shape.normals,
        triangle_indices=shape.triangles,
        albedo_factor=[*_rgb([shape.color])[0], 255],
    )


def _rgb(colors: Iterable[tuple[float, float, float]]) -> np.ndarray:
    """Return colors (n, 3) in [0, 1] as bytes."""
    return np.round(255.0 * np.clip(list(colors), 0.0, 1.0)).astype(np.uint8)


def velocities(recording: "Recording", rank: int) -> tuple[np.ndarray, np.ndarray]:
    """Return commanded and actual horizontal velocity [m/s] of a world's base, world axes, (frames, 3) each.

    Commands are turned by the base's yaw; NaN is replaced by 0. Actual: central differences of the base's origin.
    """
    base = recording.body_poses(rank)[:, 0].astype(float)
    x, y, z, w = base[:, 3:].T
    yaw = np.arctan2(2.0 * (x * y + w * z), 1.0 - 2.0 * (y * y + z * z))
    ahead, left = recording.commands[:, rank, :2].T
    commanded = np.stack([np.cos(yaw) * ahead - np.sin(yaw) * left, np.sin(yaw) * ahead + np.cos(yaw) * left], axis=1)
    moves = len(base) > 1
    actual = np.gradient(base[:, :2], recording.times, axis=0) if moves else np.zeros_like(base[:, :2])
    return tuple(np.pad(np.nan_to_num(values), ((0, 0), (0, 1))) for values in (commanded, actual))


def view_targets(recording: "Recording") -> tuple[np.ndarray, float]:
    """Return the point that the eye looks at [m], world frame, (frames, 3), and the eye's distance from it [m].

    The point follows the mean horizontal position of the worlds' bases, at the mean of their extreme heights.
    """
    count = len(recording.worlds)
    base = np.stack([recording.body_poses(rank)[:, 0, :3] for rank in range(count)], axis=1).astype(float)
    base[..., 1] += recording.spacing * np.arange(count)
    base = np.nan_to_num(base)
    target = base.mean(axis=1)
    low, high = base[..., 2].min(), base[..., 2].max()
    target[:, 2] = 0.5 * (low + high)
    spread = np.linalg.norm((base - target[:, None])[..., :2], axis=2).max()
    return target, max(EYE_DISTANCE, 1.5 * (high - low)) + 1.5 * spread


@dataclass(frozen=True)
class _Plot:
    """Curves of one entity."""

    group: str  # of the series
    title: str  # `quantity [unit]`
    names: list[str]  # of the curves, for the legend
    colors: list[tuple[float, float, float]]  # of the curves
    widths: list[float]  # [px] of the curves
    values: np.ndarray  # (frames, curves)
    by_leg: bool  # whether there is one curve for each leg

    @property
    def entity(self) -> list[str]:
        """Parts of the entity's path."""
        return ["series", self.group, self.title]


def _plots(recording: "Recording") -> list[_Plot]:
    """Return the series in their order; those of the legs of one motor, or of the paws, together, in the order of legs.

    Colors: of the leg; for several worlds, of the world; else of commanded or actual quantities.
    """
    plots: list[_Plot] = []
    worlds, palette = _world_names(recording), list(LEG_COLORS.values())
    legs: dict[tuple[str, str], dict[str, np.ndarray]] = {}  # by group and title, then by leg
    for name, values in recording.series.items():
        group, quantity = name.split("/", 1)
        if match := LEG_QUANTITY.fullmatch(quantity):
            leg, motor, unit = match.groups()
            legs.setdefault((group, f"{motor or 'paw'} {unit}"), {})[leg] = values
            continue
        commanded = quantity.startswith("command")
        color = COMMAND_COLOR if commanded else ACTUAL_COLOR
        if len(worlds) > 1:
            of = [rank for rank, world in enumerate(worlds) if f", {world} [" in quantity]
            color = palette[of[0] % len(palette)] if of else color
        width = LINE_WIDTHS[0 if commanded else 1]
        plots.append(_Plot(group, quantity, [quantity], [color], [width], values[:, None], False))
    for (group, title), by_leg in legs.items():
        order = [leg for leg in LEG_COLORS if leg in by_leg]
        colors, widths = [LEG_COLORS[leg] for leg in order], [LINE_WIDTHS[1]] * len(order)
        plots.append(_Plot(group, title, order, colors, widths, np.stack([by_leg[leg] for leg in order], axis=1), True))
    return plots


def _blueprint(recording: "Recording") -> Any:
    """Return the viewer's layout: scene and states on the left, on the right plots, those of motors in tabs.

    It plays in a loop from the beginning, with all panels collapsed.
    """
    import rerun as rr
    import rerun.blueprint as rrb

    start, end = float(recording.times[0]), float(recording.times[-1])
    limits = (rrb.TimeRangeBoundary.absolute(seconds=t) for t in (start, end + LEGEND_SHARE * (end - start)))
    axis = rrb.TimeAxis(view_range=rr.TimeRange(*limits))
    legend = rrb.PlotLegend(rrb.Corner2D.RightTop)
    by_group: dict[str, list[Any]] = {}
    for group in dict.fromkeys(plot.group for plot in _plots(recording)):
        plots = [plot for plot in _plots(recording) if plot.group == group]
        titles = [(plot.entity, f"{group} {plot.title}") for plot in plots] if plots[0].by_leg else [(["series", group], group)]
        by_group[group] = [
            rrb.TimeSeriesView(origin=rr.new_entity_path(entity), name=title, axis_x=axis, plot_legend=legend)
            for entity, title in titles
        ]
    views = [views[0] for views in by_group.values() if len(views) == 1]
    tabs = [rrb.Vertical(*views, name=group) for group, views in by_group.items() if len(views) > 1]
    right = [*views, *([rrb.Tabs(*tabs)] if tabs else [])]
    left: list[Any] = [_scene_view(recording)]
    if recording.states:
        left.append(rrb.StateTimelineView(origin="/states", name="states", time_view=axis))
    columns = [rrb.Vertical(*left, row_shares=[5, 1][: len(left)])]
    if right:
        columns.append(rrb.Vertical(*right, row_shares=[1.0] * len(views) + [2.0] * (len(right) - len(views))))
    panel = rrb.TimePanel(timeline=TIMELINE, state="collapsed", play_state="playing", loop_mode="all")
    layout = rrb.Horizontal(*columns, column_shares=[3, 2][: len(columns)])
    return rrb.Blueprint(layout, panel, rrb.BlueprintPanel(state="collapsed"), rrb.SelectionPanel(state="collapsed"))


def _scene_view(recording: "Recording") -> Any:
    """Return the view of the scene, whose eye follows `scene/view_target`."""
    import rerun.blueprint as rrb

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
