"""Additions to a recording: goal markers on the ground and moving blocks."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import trimesh

from jumper_warp.viz.recording import Recording
from jumper_warp.viz.shapes import ShapeMesh
from jumper_warp.viz.style import GOAL_COLOR

RING_RADIUS = 0.1  # [m] outer radius: the largest error of a successful jump
RING_WIDTH = 0.015  # [m]
MARK_LIFT = 0.003  # [m] height above the goal, so that the ground does not hide the ring
BAR_LENGTH, BAR_WIDTH, BAR_DISTANCE = 1.2, 0.012, 0.45  # [m] of a bar; distance from the robot
BLOCK_COLOR = (0.55, 0.45, 0.35)  # RGB, each in [0, 1]


def goal_shapes(recording: Recording) -> list[ShapeMesh]:
    """Return the shapes that mark a recording's goals: rings on the ground, bars at commanded heights.

    A ring has the radius of the tolerance of success. The two bars are parallel to x, on both sides of the robot.
    """
    marks = []
    for rank in range(len(recording.worlds)):
        shift = np.array([0.0, rank * recording.spacing, 0.0])
        for number, goal in enumerate(recording.goals[rank] if len(recording.goals) else ()):
            if np.isfinite(goal).all():
                ring = trimesh.creation.annulus(RING_RADIUS - RING_WIDTH, RING_RADIUS, 2.0 * MARK_LIFT, sections=48)
                marks.append(_mark(f"goal_{rank}_{number}", ring, goal + shift))
        if len(recording.heights) and np.isfinite(recording.heights[rank]):
            base = recording.body_poses(rank)[0, 0, :2]
            for side in (-1.0, 1.0):
                bar = trimesh.creation.box(extents=(BAR_LENGTH, BAR_WIDTH, BAR_WIDTH))
                place = np.array([base[0], base[1] + side * BAR_DISTANCE, recording.heights[rank]])
                marks.append(_mark(f"height_{rank}_{'left' if side > 0 else 'right'}", bar, place + shift))
    return marks


def _mark(name: str, mesh: trimesh.Trimesh, place: np.ndarray) -> ShapeMesh:
    """Return a mesh at a place [m], world frame, as a shape in the color of goals."""
    mesh = mesh.smooth_shaded
    vertices = (np.asarray(mesh.vertices) + place).astype(np.float32)
    normals = np.asarray(mesh.vertex_normals, np.float32)
    return ShapeMesh(name, -1, GOAL_COLOR, vertices, normals, np.asarray(mesh.faces, np.int32))


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
