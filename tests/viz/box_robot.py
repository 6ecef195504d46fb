"""Hand-made recordings of a robot that is one green box, and optics of a pinhole camera."""

import math

import numpy as np
import trimesh

from columns import POS, X, Z
from jumper_warp.viz.recording import Recording
from jumper_warp.viz.shapes import ShapeMesh

RATE = 60.0  # [Hz] frames of a recording
GREEN = (0.0, 0.8, 0.0)  # RGB of the robot
STANDING = 0.3  # [m] height of the base of a standing robot


def shape(mesh, color, body=0):
    """Return a trimesh [m] in the body's frame as a shape; body -1: fixed to the world."""
    surface = (np.asarray(mesh.vertices, np.float32), np.asarray(mesh.vertex_normals, np.float32))
    return ShapeMesh("shape", body, color, *surface, np.asarray(mesh.faces, np.int32))


def box_recording(positions, *, forces=None, yaw=0.0, **fields):
    """Return a recording of boxes 0.3 m long, one a world, above a dark ground; fields: of `Recording`.

    positions: [m] of the bases, world frame, (frames, 3) or (frames, worlds, 3). forces: on the only paw, upward [N],
    (frames,), the same in all worlds (default: 100 N). yaw: of the bases [rad].
    """
    positions = np.asarray(positions, dtype=float)
    positions = positions[:, None] if positions.ndim == 2 else positions
    frames, worlds = positions.shape[:2]
    poses = np.zeros((frames, worlds, 7), np.float32)
    poses[..., POS], poses[..., 5], poses[..., 6] = positions, math.sin(0.5 * yaw), math.cos(0.5 * yaw)
    paws = np.zeros((frames, worlds, 1, 3), np.float32)
    paws[..., 0, :] = positions - [0.0, 0.0, STANDING]
    contact = np.zeros_like(paws)
    contact[..., 2] = (np.full(frames, 100.0) if forces is None else np.asarray(forces))[:, None, None]
    ground = trimesh.creation.box(extents=(20.0, 20.0, 0.02)).apply_translation((0.0, 0.0, -0.02))
    boxes = [shape(trimesh.creation.box(extents=(0.3, 0.2, 0.1)), GREEN, world) for world in range(worlds)]
    return Recording(
        **{
            "times": np.arange(frames) / RATE,
            "worlds": tuple(range(worlds)),
            "bodies": tuple(f"world_{world}/body" for world in range(worlds)),
            "poses": poses,
            "series": {},
            "contact_points": paws,
            "contact_forces": contact,
            "shapes": (*boxes, shape(ground, (0.3, 0.3, 0.3), -1)),
            **fields,
        }
    )


def walk(distance, seconds=0.5):
    """Return base positions [m], (frames, 3), of a robot that moves at constant velocity along x."""
    frames = round(seconds * RATE) + 1
    positions = np.zeros((frames, 3))
    positions[:, X], positions[:, Z] = np.linspace(0.0, distance, frames), STANDING
    return positions


def pinhole(points, eye, target, field_of_view, size):
    """Return pixels (n, 2) of points (n, 3) [m] by azimuth and elevation of the view; field_of_view: vertical [deg]."""
    dx, dy, dz = np.asarray(target, dtype=float) - eye
    azimuth, elevation = math.atan2(dy, dx), math.atan2(dz, math.hypot(dx, dy))
    x, y, z = (np.asarray(points, dtype=float) - eye).T
    forward, left = math.cos(azimuth) * x + math.sin(azimuth) * y, math.cos(azimuth) * y - math.sin(azimuth) * x
    depth, up = (
        math.cos(elevation) * forward + math.sin(elevation) * z,
        math.cos(elevation) * z - math.sin(elevation) * forward,
    )
    focal = 0.5 * size[1] / math.tan(math.radians(0.5 * field_of_view))
    return np.stack([0.5 * size[0] - focal * left / depth, 0.5 * size[1] - focal * up / depth], axis=1)


def colored(image, channel):
    """Return whether each pixel's RGB channel exceeds the others by over 60 of 255, bool (height, width)."""
    pixels = np.asarray(image)[..., :3].astype(int)
    return pixels[..., channel] > np.delete(pixels, channel, axis=2).max(axis=2) + 60
