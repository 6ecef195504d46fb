"""Camera that follows each robot of a simulation and draws one image per world."""

from __future__ import annotations

from dataclasses import replace
from typing import cast

import newton
import numpy as np
import warp as wp

from jumper_warp.robot.model import GROUND_COLOR, build_model
from jumper_warp.sim.model_parts import find_ground
from jumper_warp.sim.simulation import Simulation
from jumper_warp.utils.newton_types import Model
from jumper_warp.viz.film import DIRECTION
from jumper_warp.viz.props import BLOCK_COLOR
from jumper_warp.viz.renderer import Renderer, View, open_renderer
from jumper_warp.viz.scene import DEAD_ZONE, corners, fit
from jumper_warp.viz.shapes import CHECKER_CELL, ShapeMesh, shape_meshes

PERIOD = 2.0 * CHECKER_CELL  # [m] period of the drawn plane's pattern
NEAR = 1.5  # [m] distance of a robot from the drawing's origin at which the origin moves to it
REACH = 5.0  # [m] half the side of the part of a heightfield that is drawn
NODES = 100  # largest number of nodes of this part on each side of its middle, along an axis
BELOW = -1000.0  # [m] height of the scenery of worlds that are not being drawn


class WorldCamera:
    """Camera that draws a simulation's first worlds, each with robot, ground and blocks, without changing them.

    All worlds share a renderer, which opens at the first image and holds one robot and the scenery of every world. It
    loads the scenery again when a block changes its size, or a robot on a heightfield moves by more than NEAR.
    """

    def __init__(self, sim: Simulation, count: int, size: tuple[int, int]) -> None:
        """Prepare images of the first `count` worlds; size: width and height [px].

        Targets and origins are infinitely far at first, so that the first image moves them to the robots.
        """
        self._count = count
        self._size = size
        self._sim = sim
        self._ground = sim.dynamics.robot.ground
        shape = find_ground(sim.model)
        self._is_field = shape >= 0 and sim.model.shape_type.numpy()[shape] == int(newton.GeoType.HFIELD)
        self._heights = self._ground.heights.numpy()
        self._shapes = shape_meshes(build_model(1, description=sim.descriptions[0], ground=None, device="cpu"), (0,))
        self._num_links = 1 + max(mesh.body for mesh in self._shapes)
        if not self._is_field:
            self._shapes += shape_meshes(sim.model, ())
        self._offset = fit(corners(np.stack([-DEAD_ZONE, DEAD_ZONE])), np.array(DIRECTION), size)
        self._targets = np.full((count, 3), np.inf)  # [m] points that the camera is aimed at, world frame
        self._origins = np.full((count, 2), np.inf)  # [m] x and y of the drawing's origin, world frame
        self._scenery = np.empty(0)  # see `_present_scenery`
        self._renderer: Renderer | None = None

    def images(self) -> list[np.ndarray]:
        """Return an image of each world's current state, (height, width, 3) uint8, RGB. Waits for the device."""
        links = self._sim.links()[0][: self._count].astype(float)
        self._follow(links[:, 0, :3])
        scenery, blocks = self._present_scenery()
        renderer = self._renderer_of(scenery)
        return [self._image(renderer, rank, links[rank], blocks[rank]) for rank in range(self._count)]

    def close(self) -> None:
        """Close the renderer."""
        if self._renderer is not None:
            self._renderer.close()
            self._renderer = None

    def _follow(self, bases: np.ndarray) -> None:
        """Move camera targets and drawing origins to the robots; bases: positions (count, 3) [m], world frame.

        A target follows smoothly within DEAD_ZONE, and jumps with a robot that was reset. Origins move by whole periods
        of the ground's pattern, so that it seems at rest.
        """
        targets = bases + np.clip(self._targets - bases, -DEAD_ZONE, DEAD_ZONE)
        jumped = np.abs(self._targets - bases).max(axis=1) > NEAR  # also at the first image
        self._targets = np.where(jumped[:, None], bases, targets)
        far = np.abs(self._origins - bases[:, :2]).max(axis=1) > NEAR
        self._origins[far] = PERIOD * np.round(bases[far, :2] / PERIOD)

    def _present_scenery(self) -> tuple[np.ndarray, np.ndarray]:
        """Return place and size of each world's scenery, (count, 5) [m], and centres of blocks, (count, 2) [m].

        Columns: origin x, y of the drawn part of a heightfield; half extents x, y and height of the block, or 0.
        """
        scenery = np.zeros((self._count, 5))
        centers = np.zeros((self._count, 2))
        if self._is_field:
            scenery[:, :2] = self._origins
        if self._ground.blocks.shape[0]:
            blocks = self._ground.blocks.numpy()[: self._count]
            exists = blocks["exists"] != 0
            centers = blocks["center"].astype(float)
            scenery[exists, 2:4] = blocks["half"][exists]
            scenery[exists, 4] = blocks["height"][exists]
        return scenery, centers

    def _renderer_of(self, scenery: np.ndarray) -> Renderer:
        """Return the renderer for a scenery (see `_present_scenery`), after loading the scenery if it changed."""
        if self._renderer is None or not np.array_equal(scenery, self._scenery):
            bodies = [*self._shapes, *self._scenery_shapes(scenery)], self._num_links + 2 * self._count
            if self._renderer is None:
                self._renderer = open_renderer(*bodies, self._size)
            else:
                self._renderer.load(*bodies)
            self._scenery = scenery
        return self._renderer

    def _scenery_shapes(self, scenery: np.ndarray) -> list[ShapeMesh]:
        """Return the shapes of every world's scenery; bodies after the links: heightfield and block of each world."""
        builder = newton.ModelBuilder()
        bodies = []
        builder.default_shape_cfg = newton.ModelBuilder.ShapeConfig(has_shape_collision=False)
        for rank, (x, y, half_x, half_y, height) in enumerate(scenery):
            body = self._num_links + 2 * rank
            if self._is_field:
                field, place = self._part_of_field(x, y)
                builder.add_shape_heightfield(xform=wp.transform(place), heightfield=field, color=GROUND_COLOR)
                bodies.append(body)
            if height > 0.0:
                place = wp.transform((0.0, 0.0, 0.5 * height))
                builder.add_shape_box(-1, xform=place, hx=half_x, hy=half_y, hz=0.5 * height, color=BLOCK_COLOR)
                bodies.append(body + 1)
        if not bodies:
            return []
        meshes = shape_meshes(cast(Model, builder.finalize(device="cpu")), ())
        return [replace(mesh, body=body) for mesh, body in zip(meshes, bodies, strict=True)]

    def _part_of_field(self, x: float, y: float) -> tuple[newton.Heightfield, tuple[float, float, float]]:
        """Return the heightfield around a point [m], world frame, and its middle relative to the point [m].

        Beyond the rim the heights are those of the rim, as in the simulation.
        """
        axes = []
        ground = self._ground
        rows, cols = self._heights.shape
        for point, center, half, count in ((y, ground.center_y, ground.half_y, rows),
                                           (x, ground.center_x, ground.half_x, cols)):  # fmt: skip
            cell = 2.0 * half / (count - 1)
            stride = max(1, int(np.ceil(REACH / cell / NODES)))
            side = stride * np.arange(-int(REACH / cell / stride), int(REACH / cell / stride) + 1)
            middle = round((point - center + half) / cell)
            axes.append((np.clip(middle + side, 0, count - 1), side[-1] * cell, center - half + middle * cell - point))
        (row, half_y, shift_y), (col, half_x, shift_x) = axes
        data = self._heights[np.ix_(row, col)].astype(np.float32)
        field = newton.Heightfield(data=data, nrow=len(row), ncol=len(col), hx=half_x, hy=half_y)
        return field, (shift_x, shift_y, 0.0)

    def _image(self, renderer: Renderer, rank: int, links: np.ndarray, block: np.ndarray) -> np.ndarray:
        """Draw a world, and return its image; links: poses (21, 7), block: centre (2,) [m], world frame."""
        poses = np.zeros((self._num_links + 2 * self._count, 7))
        poses[:, 6] = 1.0
        poses[self._num_links :, 2] = BELOW
        origin = self._origins[rank]
        body = self._num_links + 2 * rank
        poses[: self._num_links] = links
        poses[: self._num_links, :2] -= origin
        poses[body : body + 2, 2] = 0.0
        poses[body + 1, :2] = block - origin
        target = self._targets[rank] - [*origin, 0.0]
        return renderer.draw(poses, View(target + self._offset.eye, target + self._offset.target))
