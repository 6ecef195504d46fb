"""Recordings as files of the Rerun viewer: `rerun FILE.rrd` shows them.

Entities:
    scene/<shape>                 ground and other shapes that are fixed to the world
    scene/world_<i>/<link>        pose of a link over time
    scene/world_<i>/<link>/<shape>
    scene/world_<i>/contact_forces
    series/<group>/<quantity [unit]>

No viewer is started and no port is opened.
"""

import os
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Any

import numpy as np

from jumper_warp.viz.shapes import ShapeMesh

if TYPE_CHECKING:
    from jumper_warp.viz.recording import Recording

TIMELINE = "time"  # name of the only timeline; durations [s]
FORCE_SCALE = 1.0e-3  # [m/N] length of a contact arrow over its force
ARROW_RADIUS = 0.006  # [m]
ARROW_COLOR = (220, 60, 40)  # RGB, each 0 to 255
EYE_OFFSET = np.array([1.3, 1.7, 0.6])
"""[m] Vector from the target of the view to the eye, world frame, for a robot that stays in place."""


def write_rrd(recording: "Recording", path: Path) -> Path:
    """Write a recording atomically as a Rerun file (.rrd); return the path.

    Raises ImportError: rerun-sdk is not installed; OSError.
    """
    rr = _import_rerun()
    temporary = path.with_name(f".{path.name}.{os.getpid()}")
    stream = rr.RecordingStream("jumper-warp")
    try:
        stream.save(temporary, default_blueprint=_blueprint(recording))
        _log_scene(rr, stream, recording)
        _log_series(rr, stream, recording)
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


def _log_scene(rr: ModuleType, stream: Any, recording: "Recording") -> None:
    """Log the shapes once, and the poses and contact forces of all frames with one call for each entity."""
    times = [rr.TimeColumn(TIMELINE, duration=recording.times)]
    stream.log("scene", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
    for shape in recording.shapes:
        parent = ["scene"] if shape.body < 0 else ["scene", *recording.bodies[shape.body].split("/")]
        stream.log(rr.new_entity_path([*parent, shape.name]), _mesh(rr, shape), static=True)
    for index, body in enumerate(recording.bodies):
        pos, quat = np.split(recording.poses[:, index], [3], axis=1)
        columns = rr.Transform3D.columns(translation=pos, quaternion=quat)
        stream.send_columns(rr.new_entity_path(["scene", *body.split("/")]), times, columns)
    for rank, world in enumerate(recording.worlds):
        offset = rr.Transform3D(translation=[0.0, rank * recording.spacing, 0.0])
        stream.log(f"scene/world_{world}", offset, static=True)
        _log_contacts(rr, stream, f"scene/world_{world}/contact_forces", times, recording, rank)


def _log_contacts(
    rr: ModuleType, stream: Any, entity: str, times: list[Any], recording: "Recording", rank: int
) -> None:
    """Log one world's contact forces as arrows of an entity; times: Rerun's time columns; rank: index in `worlds`."""
    points, forces = recording.contact_points[:, rank], recording.contact_forces[:, rank]
    frames, contacts = points.shape[:2]
    if contacts == 0:
        return
    stream.log(entity, rr.Arrows3D.from_fields(radii=ARROW_RADIUS, colors=ARROW_COLOR), static=True)
    columns = rr.Arrows3D.columns(origins=points.reshape(-1, 3), vectors=FORCE_SCALE * forces.reshape(-1, 3))
    stream.send_columns(entity, times, columns.partition([contacts] * frames))


def _mesh(rr: ModuleType, shape: ShapeMesh) -> Any:
    """Return a shape as Rerun's mesh, in the body's frame, with an opaque color."""
    color = [round(255 * min(max(channel, 0.0), 1.0)) for channel in shape.color]
    return rr.Mesh3D(
        vertex_positions=shape.vertices,
        vertex_normals=shape.normals,
        triangle_indices=shape.triangles,
        albedo_factor=[*color, 255],
    )


def _log_series(rr: ModuleType, stream: Any, recording: "Recording") -> None:
    """Log each series as a scalar over time, entity `series/<group>/<quantity [unit]>`."""
    times = [rr.TimeColumn(TIMELINE, duration=recording.times)]
    for name, values in recording.series.items():
        group, quantity = name.split("/", 1)
        entity = rr.new_entity_path(["series", group, quantity])
        stream.log(entity, rr.SeriesLines(names=quantity), static=True)
        stream.send_columns(entity, times, rr.Scalars.columns(scalars=values))


def _blueprint(recording: "Recording") -> Any:
    """Return the viewer's layout: scene on the left, on the right a plot for each group of series."""
    import rerun as rr
    import rerun.blueprint as rrb

    target, eye = _viewpoint(recording)
    scene = rrb.Spatial3DView(
        origin="/scene",
        name="scene",
        eye_controls=rrb.EyeControls3D(position=eye, look_target=target, eye_up=[0.0, 0.0, 1.0]),
        line_grid=False,
    )
    groups = dict.fromkeys(name.split("/")[0] for name in recording.series)
    plots = [rrb.TimeSeriesView(origin=rr.new_entity_path(["series", group]), name=group) for group in groups]
    layout = rrb.Horizontal(scene, rrb.Vertical(*plots), column_shares=[3, 2]) if plots else scene
    panel = rrb.TimePanel(timeline=TIMELINE, state="collapsed")
    return rrb.Blueprint(layout, panel, rrb.BlueprintPanel(state="collapsed"), rrb.SelectionPanel(state="collapsed"))


def _viewpoint(recording: "Recording") -> tuple[np.ndarray, np.ndarray]:
    """Return target and eye of the view [m], world frame, (3,) each, so that all worlds' motions are visible."""
    pos = recording.poses[..., :3].reshape(len(recording.times), len(recording.worlds), -1, 3)
    pos = pos + recording.spacing * np.arange(len(recording.worlds))[:, None, None] * np.array([0.0, 1.0, 0.0])
    points = pos.reshape(-1, 3)
    points = points[np.isfinite(points).all(axis=1)]
    if len(points) == 0:
        return np.zeros(3), EYE_OFFSET
    low, high = points.min(axis=0), points.max(axis=0)
    target = 0.5 * (low + high)
    return target, target + EYE_OFFSET * max(1.0, float(np.linalg.norm(high - low)))
