"""Live view of watched worlds in the Rerun viewer: scene, reward terms as stacked bars, and learning curves.

Entities; times are training times [s], so that robots and curves share the timeline:
    scene/ground, scene/<link>    meshes; one instance of a link for each robot
    scene/names, scene/goals      labels above the robots, and rings at their goals
    rewards                       sums of the reward terms over the episode, one stacked bar for each robot
    curves/<group>/<name>         metrics of the training, from its metrics file
    status                        text
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from jumper_warp.live.curves import GROUPS, curves_of
from jumper_warp.live.scene import RobotScene
from jumper_warp.viz.shapes import ShapeMesh
from jumper_warp.viz.style import GOAL_COLOR, SERIES_COLORS

TIMELINE = "time"
RING = 0.1 * np.stack([np.cos(a := np.linspace(0.0, 2.0 * np.pi, 25)), np.sin(a), 0.0 * a], axis=1)  # [m]
ABOVE = np.array([0.0, 0.0, 0.3])  # [m] from a robot's base to its name
EYE = np.array([3.2, -1.0, 1.9])  # [m] camera, from the middle of the robots


class RerunView:
    """View of the robots of several slots in a Rerun stream."""

    rate = 4.0  # [1/s] updates of the robots; each brings all poses since the last one

    def __init__(self, stream: Any, scene: RobotScene, names: Sequence[str], terms: Sequence[str]) -> None:
        """Log everything that does not change; stream: a `RecordingStream`; names: of the slots; terms: of rewards."""
        self._stream = stream
        self._names = list(names)
        self._terms = list(terms)
        self._links = [f"scene/{link}" for link in scene.links]
        self._largest = 1.0e-6  # Largest height of a bar so far
        stream.send_blueprint(blueprint(), make_active=True, make_default=True)
        stream.log("scene", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
        for body, entity in enumerate(["scene/ground", *self._links], start=-1):
            stream.log(entity, _mesh([shape for shape in scene.shapes if shape.body == body]), static=True)
        colors = np.array(SERIES_COLORS)[np.arange(len(terms)) % len(SERIES_COLORS)]
        places = [[len(names) + 0.2, 1.0 - 2.0 * i / max(len(terms) - 1, 1)] for i in range(len(terms))]
        legend = rr.Points2D(_upright(places), labels=self._terms, colors=_rgb(colors), radii=0.03, show_labels=True)
        stream.log("rewards/legend", legend, static=True)
        self._colors = _rgb(np.tile(colors, (len(names), 1)))

    def show(self, times: np.ndarray, poses: np.ndarray, goals: np.ndarray) -> None:
        """Show the robots; times [s]: (frames,); poses: (frames, slots, links, 7) as drawn; goals [m]: (slots, 3)."""
        column = [rr.TimeColumn(TIMELINE, duration=times)]
        lengths = [poses.shape[1]] * len(times)
        for link, entity in enumerate(self._links):
            flat = poses[:, :, link].reshape(-1, 7)
            instances = rr.InstancePoses3D.columns(translations=flat[:, :3], quaternions=flat[:, 3:])
            self._stream.send_columns(entity, column, instances.partition(lengths))
        self._stream.set_time(TIMELINE, duration=times[-1])
        self._stream.log("scene/names", rr.Points3D(poses[-1, :, 0, :3] + ABOVE, labels=self._names, radii=0.0))
        rings = [goal + RING for goal in goals if np.isfinite(goal).all()]
        self._stream.log("scene/goals", rr.LineStrips3D(rings, colors=_rgb([GOAL_COLOR]), radii=0.01))

    def show_rewards(self, when: float, sums: np.ndarray) -> None:
        """Show stacked bars of the terms' sums over the episodes, (slots, terms), at a time [s].

        Positive terms are stacked upward, negative ones downward. The largest bar so far has a height of 1.
        """
        tops = np.where(sums > 0.0, np.cumsum(np.maximum(sums, 0.0), axis=1), np.cumsum(np.minimum(sums, 0.0), axis=1))
        self._largest = max(self._largest, float(np.abs(tops).max()))
        centers = (tops - 0.5 * sums) / self._largest
        columns = np.broadcast_to(np.arange(len(sums))[:, None], centers.shape)
        half = np.abs(0.5 * sums) / self._largest
        self._stream.set_time(TIMELINE, duration=when)
        boxes = rr.Boxes2D(
            centers=_upright(np.stack([columns, centers], axis=-1).reshape(-1, 2)),
            half_sizes=np.stack([np.full_like(half, 0.35), half], axis=-1).reshape(-1, 2), colors=self._colors,
        )  # fmt: skip
        self._stream.log("rewards/terms", boxes)
        labels = [f"{name} {total:.3g}" for name, total in zip(self._names, sums.sum(axis=1), strict=True)]
        places = _upright([[i, -1.1] for i in range(len(sums))])
        self._stream.log("rewards/names", rr.Points2D(places, labels=labels, radii=0.0, show_labels=True))

    def show_curves(self, lines: Sequence[dict[str, Any]], label: str = "") -> None:
        """Append lines of a metrics file to the curves; label: of the seed, empty for a single one."""
        for (group, name), points in curves_of(lines, label).items():
            when, values = np.array(points).T
            column = [rr.TimeColumn(TIMELINE, duration=when)]
            entity = rr.new_entity_path(["curves", group, name])
            self._stream.send_columns(entity, column, rr.Scalars.columns(scalars=values))

    def show_status(self, text: str) -> None:
        """Show a text in Markdown."""
        self._stream.log("status", rr.TextDocument(text, media_type="text/markdown"))


def blueprint() -> rrb.Blueprint:
    """Return the layout: robots above stacked rewards on the left, curves on the right; the view follows new data."""
    eye = rrb.EyeControls3D(position=EYE, look_target=[0.0, 0.0, 0.3], eye_up=[0.0, 0.0, 1.0])
    left = rrb.Vertical(
        rrb.Spatial3DView(origin="/scene", name="robots", eye_controls=eye, line_grid=False),
        rrb.Spatial2DView(origin="/rewards", name="reward terms, sums over the episode"),
        row_shares=[3, 2],
    )
    curves = {
        group: rrb.TimeSeriesView(origin=f"/curves/{group}", name=group) for group in dict.fromkeys(GROUPS.values())
    }
    first = [curves.pop(group) for group in ("reward", "metrics", "terminations", "curriculum")]
    status = rrb.TextDocumentView(origin="/status", name="status")
    right = rrb.Vertical(*first, rrb.Tabs(status, *curves.values()), row_shares=[1, 1, 1, 1, 1])
    panel = rrb.TimePanel(timeline=TIMELINE, state="collapsed", play_state="following")
    layout = rrb.Horizontal(left, right, column_shares=[3, 2])
    return rrb.Blueprint(layout, panel, rrb.BlueprintPanel(state="collapsed"), rrb.SelectionPanel(state="collapsed"))


def _mesh(shapes: Sequence[ShapeMesh]) -> rr.Mesh3D:
    """Return shapes in one frame as one mesh, so that a link is one entity."""
    firsts = np.cumsum([0, *(len(shape.vertices) for shape in shapes)])
    triangles = [shape.triangles + first for shape, first in zip(shapes, firsts, strict=False)]
    colors = [np.tile(_rgb(shape.color), (len(shape.vertices), 1)) for shape in shapes]
    return rr.Mesh3D(
        vertex_positions=np.concatenate([shape.vertices for shape in shapes]),
        vertex_normals=np.concatenate([shape.normals for shape in shapes]),
        triangle_indices=np.concatenate(triangles), vertex_colors=np.concatenate(colors),
    )  # fmt: skip


def _upright(points: Any) -> np.ndarray:
    """Return points (n, 2) with y upward as Rerun's, whose y is downward."""
    return np.asarray(points, dtype=np.float32).reshape(-1, 2) * (1.0, -1.0)


def _rgb(colors: Any) -> np.ndarray:
    """Convert colors (n, 3) in [0, 1] to bytes."""
    return np.round(255.0 * np.asarray(colors)).astype(np.uint8)
