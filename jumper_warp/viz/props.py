"""Shapes added to a recording: markers of goals and commanded heights, and moving blocks."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import trimesh

from jumper_warp.viz.recording import Recording
from jumper_warp.viz.shapes import ShapeMesh, smooth_shape
from jumper_warp.viz.style import GOAL_COLOR

RING_RADIUS = 0.1  # [m] outer radius of a goal's ring: largest error of a successful jump
RING_WIDTH, RING_HEIGHT = 0.012, 0.006  # [m] sides of the ring's rectangular cross-section
BAR_SIZE = (1.2, 0.012, 0.012)  # [m] extents of a bar at the commanded height, along x, y, z
BAR_OFFSET = 0.45  # [m] distance along y from the base's start to the bar
BLOCK_COLOR = (0.55, 0.45, 0.35)  # RGB, each in [0, 1]


def goal_shapes(recording: Recording) -> list[ShapeMesh]:
    """Return the markers of goals (rings on the surface under them) and of commanded heights (bars), world frame.

    A bar is parallel to x, to the left of the base's first position. Markers of later worlds are moved along y by the
    recording's spacing. Names: `goal_<rank>_<number>`, `height_<rank>`; NaN goals and heights have no marker.
    """
    shapes = []
    for rank, goals in enumerate(recording.goals):
        for number, goal in enumerate(goals):
            ring = trimesh.creation.annulus(RING_RADIUS - RING_WIDTH, RING_RADIUS, RING_HEIGHT, sections=48)
            place = np.append(goal[:2], _surface_height(recording, rank, goal) + 0.5 * RING_HEIGHT)
            shapes.append((f"goal_{rank}_{number}", rank, ring, place))
    for rank, height in enumerate(recording.heights):
        x, y = recording.body_poses(rank)[0, 0, :2]
        bar = trimesh.creation.box(extents=BAR_SIZE)
        place = np.array([x, y + BAR_OFFSET, height])
        shapes.append((f"height_{rank}", rank, bar, place))
    return [
        smooth_shape(name, -1, GOAL_COLOR, mesh.apply_translation(place + (0.0, rank * recording.spacing, 0.0)))
        for name, rank, mesh, place in shapes
        if np.isfinite(place).all()
    ]


def _surface_height(recording: Recording, rank: int, point: np.ndarray) -> float:
    """Return the height [m] of the ground under a point (3,) [m], or of the world's block at the end; else the point's.

    The highest surface counts.
    """
    block = f"world_{recording.worlds[rank]}/block"
    heights = []
    for shape in recording.shapes:
        if shape.body >= 0 and recording.bodies[shape.body] != block:
            continue
        origin = recording.poses[-1, shape.body, :3] if shape.body >= 0 else np.zeros(3)
        a, b, c = np.moveaxis((shape.vertices + origin)[shape.triangles].astype(float), 1, 0)
        ab = b - a
        ac = c - a
        offset = point - a
        with np.errstate(divide="ignore", invalid="ignore"):  # a vertical triangle has no area seen from above
            area = _cross(ab, ac)
            u = _cross(offset, ac) / area
            v = _cross(ab, offset) / area
            inside = (u > -1.0e-6) & (v > -1.0e-6) & (u + v < 1.0 + 1.0e-6)
            heights.extend((a[:, 2] + u * ab[:, 2] + v * ac[:, 2])[inside])
    return float(max(heights, default=point[2]))


def _cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return the z component of cross products, (n,), of vectors (n, 3)."""
    return a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]


def with_blocks(recording: Recording, centers: np.ndarray, half: np.ndarray, height: np.ndarray) -> Recording:
    """Add a moving block, body `world_<i>/block`, standing on z = 0, to each world of a recording; return the copy.

    centers: x and y [m], world frame, (frames, recorded worlds, 2). half: half extents along x and y [m], (recorded
    worlds, 2). height: [m], (recorded worlds,).
    """
    poses = [recording.poses]
    names = list(recording.bodies)
    shapes = list(recording.shapes)
    for rank, world in enumerate(recording.worlds):
        pose = np.zeros((len(recording.times), 1, 7), dtype=np.float32)
        pose[:, 0, :2] = centers[:, rank]
        pose[:, 0, 2] = 0.5 * height[rank]
        pose[:, 0, 6] = 1.0
        box = trimesh.creation.box(extents=(*(2.0 * half[rank]), height[rank]))
        shapes.append(smooth_shape("block", len(names), BLOCK_COLOR, box))
        names.append(f"world_{world}/block")
        poses.append(pose)
    return replace(recording, poses=np.concatenate(poses, axis=1), bodies=tuple(names), shapes=tuple(shapes))
