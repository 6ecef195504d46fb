"""Triangle meshes of the visible shapes of a Newton model."""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import trimesh

from jumper_warp.utils.errors import InputError
from jumper_warp.utils.files import Json

if TYPE_CHECKING:  # viewers that receive meshes do not need it
    import newton
    from newton import GeoType

    from jumper_warp.utils.newton_types import Model

PLANE_EXTENT = 10.0  # [m] half the side of the square drawn for an infinite plane
CHECKER_CELL = 0.5  # [m] side of one field of a drawn plane
CHECKER_COLORS = ((0.80, 0.81, 0.83), (0.70, 0.71, 0.74))  # RGB of light and dark fields, each in [0, 1]


@dataclass(frozen=True)
class ShapeMesh:
    """Triangle mesh, color and body of one shape."""

    name: str
    body: int  # index of the body in the model; -1: fixed to the world
    color: tuple[float, float, float]  # RGB, each in [0, 1]
    vertices: np.ndarray  # (num_vertices, 3) float32 [m], in the body's frame; in the world frame if fixed to the world
    normals: np.ndarray  # (num_vertices, 3) float32, outward unit normals in the same frame
    triangles: np.ndarray  # (num_triangles, 3) int32, indices of vertices


SURFACE = ("vertices", "normals", "triangles")  # fields of `ShapeMesh` that are arrays


def packed_shapes(shapes: Iterable[ShapeMesh]) -> tuple[list[Json], dict[str, np.ndarray]]:
    """Return shapes as JSON data, one entry for each, and their arrays by name, for `unpacked_shapes`."""
    shapes = list(shapes)
    entries: list[Json] = [{"name": shape.name, "body": shape.body, "color": shape.color} for shape in shapes]
    arrays = {f"shape{i}_{part}": getattr(shape, part) for i, shape in enumerate(shapes) for part in SURFACE}
    return entries, arrays


def unpacked_shapes(entries: Iterable[Json], arrays: Mapping[str, np.ndarray]) -> tuple[ShapeMesh, ...]:
    """Return the shapes that `packed_shapes` returned as entries and arrays. Raises LookupError: one is missing."""
    surfaces = ([arrays[f"shape{i}_{part}"] for part in SURFACE] for i in itertools.count())
    pairs = zip(entries, surfaces, strict=False)
    return tuple(ShapeMesh(entry["name"], entry["body"], tuple(entry["color"]), *surface) for entry, surface in pairs)


def shape_meshes(model: Model, worlds: tuple[int, ...]) -> list[ShapeMesh]:
    """Return the meshes of a model's visible shapes: those of some worlds, and those shared by all (ground).

    worlds: indices in the model. Raises InputError: a visible shape of a kind that cannot be drawn (a cone or a splat).
    """
    import newton
    from newton import GeoType

    kinds = model.shape_type.numpy()
    scales = model.shape_scale.numpy().astype(float)
    placements = model.shape_transform.numpy().astype(float)
    bodies = model.shape_body.numpy()
    colors = model.shape_color.numpy().astype(float)
    shown = (model.shape_flags.numpy() & int(newton.ShapeFlags.VISIBLE)) != 0
    meshes = []
    for shape in np.flatnonzero(shown & np.isin(model.shape_world.numpy(), [-1, *worlds])):
        label = model.shape_label[shape].split("/")[-1]
        kind = GeoType(int(kinds[shape]))
        if kind == GeoType.PLANE:
            surfaces = _checker(label, scales[shape])
        else:
            mesh = _surface(kind, scales[shape], model.shape_source[shape], label)
            surfaces = [(label, tuple(colors[shape]), mesh)]
        for name, color, mesh in surfaces:
            meshes.append(_placed(name, int(bodies[shape]), color, mesh, placements[shape]))
    return meshes


def _surface(kind: GeoType, scale: np.ndarray, source: Any, label: str) -> trimesh.Trimesh:
    """Return the triangle mesh of one shape, in its frame. Raises InputError: a kind that cannot be drawn.

    scale: Newton's three size parameters [m], or of a mesh [1]. source: mesh or heightfield. label: for the error.
    """
    from newton import GeoType

    if kind == GeoType.SPHERE:
        return trimesh.creation.icosphere(subdivisions=3, radius=scale[0])
    if kind == GeoType.CAPSULE:
        return trimesh.creation.capsule(radius=scale[0], height=2.0 * scale[1], count=[16, 16])
    if kind == GeoType.CYLINDER:
        return trimesh.creation.cylinder(radius=scale[0], height=2.0 * scale[1], sections=24)
    if kind == GeoType.ELLIPSOID:
        return trimesh.creation.icosphere(subdivisions=3).apply_scale(scale)
    if kind == GeoType.BOX:
        return trimesh.creation.box(extents=2.0 * scale)
    if kind in (GeoType.MESH, GeoType.CONVEX_MESH):
        return trimesh.Trimesh(np.asarray(source.vertices) * scale, np.asarray(source.indices).reshape(-1, 3))
    if kind == GeoType.HFIELD:
        return _heightfield(source, scale)
    raise InputError(f"shape {label!r} is a {kind.name}, which cannot be drawn")


def _heightfield(field: newton.Heightfield, scale: np.ndarray) -> trimesh.Trimesh:
    """Return the upper surface of a heightfield in the shape's frame; rows follow y, columns x. scale: (3,) [1]."""
    x = np.linspace(-field.hx, field.hx, field.ncol)
    y = np.linspace(-field.hy, field.hy, field.nrow)
    heights = field.min_z + np.asarray(field.data) * (field.max_z - field.min_z)
    vertices = np.stack([*np.meshgrid(x, y), heights], axis=-1).reshape(-1, 3) * scale
    node = np.arange(field.nrow * field.ncol).reshape(field.nrow, field.ncol)
    here = node[:-1, :-1].ravel()
    right = node[:-1, 1:].ravel()
    ahead = node[1:, :-1].ravel()
    across = node[1:, 1:].ravel()
    triangles = [np.stack([here, right, across], axis=1), np.stack([here, across, ahead], axis=1)]
    return trimesh.Trimesh(vertices, np.concatenate(triangles))


def _checker(label: str, size: np.ndarray) -> list[tuple[str, tuple[float, float, float], trimesh.Trimesh]]:
    """Return the checkerboard of a plane as (name, RGB, mesh) of its light and dark fields, in the shape's frame.

    label: of the shape. size: width along x and length along y [m], 0 if infinite.
    """
    half = np.where(size[:2] > 0.0, 0.5 * size[:2], PLANE_EXTENT)
    cells = np.maximum(1, np.round(2.0 * half / CHECKER_CELL)).astype(int)
    step = 2.0 * half / cells
    column, row = (index.ravel() for index in np.meshgrid(np.arange(cells[0]), np.arange(cells[1])))
    corner = np.stack([column * step[0] - half[0], row * step[1] - half[1], 0.0 * row], axis=1)
    outline = np.array([[0.0, 0.0, 0.0], [step[0], 0.0, 0.0], [step[0], step[1], 0.0], [0.0, step[1], 0.0]])
    surfaces = []
    for shade, color in enumerate(CHECKER_COLORS):
        chosen = corner[(column + row) % 2 == shade]
        vertices = (chosen[:, None] + outline).reshape(-1, 3)
        triangles = (4 * np.arange(len(chosen))[:, None, None] + np.array([[0, 1, 2], [0, 2, 3]])).reshape(-1, 3)
        name = f"{label}_{('light', 'dark')[shade]}"
        surfaces.append((name, color, trimesh.Trimesh(vertices, triangles, process=False)))
    return surfaces


def _placed(
    name: str, body: int, color: tuple[float, float, float], mesh: trimesh.Trimesh, placement: np.ndarray
) -> ShapeMesh:
    """Convert a mesh in the shape's frame to a `ShapeMesh` in the body's frame.

    placement: pose of the shape in the body's frame, position [m] and quaternion xyzw, (7,).
    """
    x, y, z, w = placement[3:]
    matrix = trimesh.transformations.quaternion_matrix([w, x, y, z])
    matrix[:3, 3] = placement[:3]
    red, green, blue = map(float, color)
    return smooth_shape(name, body, (red, green, blue), mesh.copy().apply_transform(matrix))


def smooth_shape(name: str, body: int, color: tuple[float, float, float], mesh: trimesh.Trimesh) -> ShapeMesh:
    """Return a mesh in the body's frame as a shape with smooth normals, sharp at edges; color: RGB, each in [0, 1]."""
    smooth = mesh.smooth_shaded
    surface = (np.asarray(smooth.vertices, np.float32), np.asarray(smooth.vertex_normals, np.float32))
    return ShapeMesh(name, body, color, *surface, np.asarray(smooth.faces, np.int32))
