"""Additions to a recording: goal markers on the ground and moving blocks."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import trimesh

from jumper_warp.viz.recording import Recording
from jumper_warp.viz.shapes import ShapeMesh

MARK_RADIUS = 0.04  # [m]
MARK_LIFT = 0.003  # [m] height above the goal, so that the ground does not hide the disc
MARK_CORNERS = 24  # of the polygon that approximates the disc
MARK_COLOR = (0.85, 0.15, 0.15)  # RGB, each in [0, 1]
BLOCK_COLOR = (0.55, 0.45, 0.35)  # RGB, each in [0, 1]


def with_goal_markers(recording: Recording, goals: np.ndarray) -> Recording:
    """Return the recording with a red disc at each finite goal.

    goals: (recorded worlds, goals by world, 3) [m], world frame.
    """
    angle = np.linspace(0.0, 2.0 * math.pi, MARK_CORNERS, endpoint=False)
    rim = MARK_RADIUS * np.stack([np.cos(angle), np.sin(angle), np.zeros_like(angle)], axis=1)
    disc = np.concatenate([np.zeros((1, 3)), rim]) + (0.0, 0.0, MARK_LIFT)
    corner = np.arange(MARK_CORNERS)
    triangles = np.stack([np.zeros_like(corner), 1 + corner, 1 + (corner + 1) % MARK_CORNERS], axis=1).astype(np.int32)
    normals = np.tile(np.array([0.0, 0.0, 1.0], np.float32), (len(disc), 1))
    marks = []
    for rank, world_goals in enumerate(goals):
        for number, goal in enumerate(world_goals):
            if np.isfinite(goal).all():
                vertices = (disc + goal + (0.0, rank * recording.spacing, 0.0)).astype(np.float32)
                marks.append(ShapeMesh(f"goal_{rank}_{number}", -1, MARK_COLOR, vertices, normals, triangles))
    return replace(recording, shapes=(*recording.shapes, *marks))


def with_blocks(recording: Recording, centers: np.ndarray, half: np.ndarray, height: np.ndarray) -> Recording:
    """Return the recording with a moving block, body `world_<i>/block`, in each world, standing on z = 0.

    centers: x and y [m], world frame, (frames, recorded worlds, 2). half: half extents along x and y [m], (recorded
    worlds, 2). height: [m], (recorded worlds,).
    """
    poses, names, shapes = [recording.poses], list(recording.bodies), list(recording.shapes)
    for rank, world in enumerate(recording.worlds):
        pose = np.zeros((len(recording.times), 1, 7), dtype=np.float32)
        pose[:, 0, :2] = centers[:, rank]
        pose[:, 0, 2] = 0.5 * height[rank]
        pose[:, 0, 6] = 1.0
        box = trimesh.creation.box(extents=(*(2.0 * half[rank]), height[rank])).smooth_shaded
        surface = (np.asarray(box.vertices, np.float32), np.asarray(box.vertex_normals, np.float32))
        shapes.append(ShapeMesh("block", len(names), BLOCK_COLOR, *surface, np.asarray(box.faces, np.int32)))
        names.append(f"world_{world}/block")
        poses.append(pose)
    return replace(recording, poses=np.concatenate(poses, axis=1), bodies=tuple(names), shapes=tuple(shapes))
