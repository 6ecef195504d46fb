"""Live scene of robots for viser, a viewer in the browser: ground, robots, goals and arrows."""

from __future__ import annotations

import contextlib
import functools
import io
import re
from collections.abc import Sequence
from typing import TYPE_CHECKING, cast

import numpy as np
import trimesh
from trimesh.visual import TextureVisuals
from trimesh.visual.material import PBRMaterial

from jumper_warp.utils.errors import InputError
from jumper_warp.viz.props import RING_HEIGHT, RING_RADIUS, RING_WIDTH
from jumper_warp.viz.shapes import CHECKER_CELL, ShapeMesh
from jumper_warp.viz.style import GOAL_COLOR

if TYPE_CHECKING:
    from viser import SceneApi, ViserServer

HOST = "127.0.0.1"
ORIGIN = re.compile(r"https?://(localhost|127\.0\.0\.1|\[::1\])(:\d+)?")
"""Pattern of the origins whose pages may connect: a page of another site that the user visits may not."""

ROOT = "/world"  # Node whose frame is the world frame, moved so that a followed point is at the viewer's origin
GROUND = f"{ROOT}/ground"
GROUND_PERIOD = 2.0 * CHECKER_CELL  # [m] Distance by which the drawn part of a plane moves with the followed point
FOG = (6.0, 14.0)  # [m] Distance from the camera at which white fog begins, and from which it hides everything
EYE = (1.3, -1.6, 0.9)  # [m] Initial position of the camera, from the followed point
GAMMA = 2.2  # Exponent from an sRGB color to the linear one that glTF stores


class ViserScene:
    """Scene of one or several robots on their ground, drawn by viser.

    The viewer's origin follows a point, so that every visitor turns the view around it with the mouse.
    """

    def __init__(self, scene: SceneApi, shapes: Sequence[ShapeMesh], robots: int = 1) -> None:
        """Draw the ground, and the links of one robot `robots` times; `update` places them.

        scene: of a viser server; shapes: `shape_meshes` of one world, their `body` being a link's index, -1 the ground.
        """
        self.scene = scene
        self.center = np.zeros(3)  # [m] Followed point, world frame
        self.marks: list = []
        scene.configure_environment_map("warehouse", environment_intensity=0.35)  # 1 bleaches the ground
        scene.configure_fog(*FOG)
        self.root = scene.add_frame(ROOT, show_axes=False)
        fixed = [shape for shape in shapes if shape.body < 0]
        self.ground = scene.add_glb(GROUND, glb_of(fixed), cast_shadow=False) if fixed else None
        self.endless = any(shape.name.endswith("_light") for shape in fixed)  # a checkered plane
        quaternions = np.tile(np.eye(4)[0], (robots, 1))
        places = np.zeros((robots, 3))
        self.links = {}
        for body in sorted({shape.body for shape in shapes} - {-1}):
            glb = glb_of([shape for shape in shapes if shape.body == body])
            self.links[body] = scene.add_batched_glb(f"/link_{body}", glb, quaternions, places, lod="off")

    def update(self, poses: np.ndarray) -> None:
        """Place all robots; poses: (robots, links, 7), position [m] and quaternion xyzw, world frame.

        Relative to the followed point and not below ROOT, which a slow browser moves later than the links.
        """
        by_link = np.moveaxis(poses, 1, 0).astype(np.float32)
        quaternions = np.roll(by_link[..., 3:], 1, axis=2)
        for body, link in self.links.items():
            link.batched_positions = (by_link[body, :, :3] - self.center).astype(np.float32)
            link.batched_wxyzs = quaternions[body]

    def follow(self, point: np.ndarray) -> None:
        """Move the viewer's origin to a point [m], (3,), world frame, for the next `update`."""
        self.center = np.asarray(point, dtype=float)
        self.root.position = -self.center
        if self.ground is not None and self.endless:
            tile = np.round(self.center[:2] / GROUND_PERIOD) * GROUND_PERIOD
            self.ground.position = np.append(tile, 0.0)

    def show_goals(self, goals: Sequence[np.ndarray]) -> None:
        """Draw a ring at each goal [m], (3,), world frame, in place of earlier rings."""
        for mark in self.marks:
            mark.remove()
        ring = trimesh.creation.annulus(RING_RADIUS - RING_WIDTH, RING_RADIUS, RING_HEIGHT, sections=48)
        lift = np.array([0.0, 0.0, RING_HEIGHT])
        color = np.round(255 * np.array(GOAL_COLOR)).astype(np.uint8)
        self.marks = [
            self.scene.add_mesh_simple(f"{ROOT}/goal_{i}", ring.vertices, ring.faces, color=color, position=goal + lift)
            for i, goal in enumerate(goals)
        ]


def open_server(port: int) -> ViserServer:
    """Start a viser server on the loopback address and return it; port: the next free one is used if it is taken.

    Pages of other origins and requests for a public tunnel are refused, which viser itself accepts.
    Raises InputError: viser is not installed.
    """
    try:
        import viser
        import websockets.asyncio.server as websocket_server
    except ImportError:
        raise InputError('the viewer in the browser needs viser: pip install "jumper-warp[drive]"') from None
    from viser._messages import ShareUrlRequest

    serve = websocket_server.serve
    websocket_server.serve = functools.partial(serve, origins=[ORIGIN])  # viser takes no origins
    try:
        with contextlib.redirect_stdout(io.StringIO()):  # its table of addresses
            server = viser.ViserServer(HOST, port, verbose=False)
    finally:
        websocket_server.serve = serve
    server._websock_server.unregister_handler(ShareUrlRequest)
    server.gui.configure_theme(show_share_button=False, show_logo=False)
    server.initial_camera.position = EYE
    server.initial_camera.look_at = (0.0, 0.0, 0.25)
    return server


def glb_of(shapes: Sequence[ShapeMesh]) -> bytes:
    """Return shapes as a binary glTF file, each in its body's frame."""
    scene = trimesh.Scene()
    for shape in shapes:
        color = [*(part**GAMMA for part in shape.color), 1.0]
        material = PBRMaterial(baseColorFactor=color, metallicFactor=0.0, roughnessFactor=0.8, doubleSided=True)
        surface = trimesh.Trimesh(shape.vertices, shape.triangles, vertex_normals=shape.normals, process=False)
        surface.visual = TextureVisuals(material=material)
        scene.add_geometry(surface, node_name=shape.name, geom_name=shape.name)
    return cast("bytes", scene.export(file_type="glb"))
