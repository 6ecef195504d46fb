"""Meshes of a model's shapes: sizes, placement, colors, and shapes that are left out."""

import math

import newton
import numpy as np
import pytest
import trimesh
import warp as wp

from jumper_warp.viz import shapes

QUARTER_TURN = wp.quat(0.0, 0.0, math.sin(math.pi / 4), math.cos(math.pi / 4))  # about z


def build(add=lambda builder, body: None, add_ground=lambda scene: None):
    """Return the meshes of world 0 of 2, with shapes from `add(builder, body)` on its one body, and `add_ground`."""
    builder = newton.ModelBuilder()
    body = builder.add_link(mass=1.0, inertia=wp.mat33(np.eye(3)), label="base")
    builder.add_articulation([builder.add_joint_free(body)])
    add(builder, body)
    scene = newton.ModelBuilder()
    scene.replicate(builder, 2, label_prefixes=["world_0", "world_1"])
    add_ground(scene)
    return shapes.shape_meshes(scene.finalize(device="cpu"), (0,))


def extent(mesh):
    """Return the size of a mesh along x, y, z [m], (3,)."""
    return mesh.vertices.max(axis=0) - mesh.vertices.min(axis=0)


def volume(mesh):
    """Return the volume of a closed mesh [m^3]."""
    return trimesh.Trimesh(mesh.vertices, mesh.triangles).volume


@pytest.mark.parametrize(
    ("add", "expected_extent", "expected_volume", "rel"),  # [m], [m^3] of the exact shape
    [
        (lambda b, i: b.add_shape_box(i, hx=0.1, hy=0.2, hz=0.3), (0.2, 0.4, 0.6), 0.048, 1e-6),
        (lambda b, i: b.add_shape_sphere(i, radius=0.1), (0.2, 0.2, 0.2), 4.18879e-3, 0.02),
        (lambda b, i: b.add_shape_capsule(i, radius=0.1, half_height=0.2), (0.2, 0.2, 0.6), 1.675516e-2, 0.05),
        (lambda b, i: b.add_shape_cylinder(i, radius=0.1, half_height=0.2), (0.2, 0.2, 0.4), 1.256637e-2, 0.02),
        (lambda b, i: b.add_shape_ellipsoid(i, rx=0.1, ry=0.2, rz=0.3), (0.2, 0.4, 0.6), 2.513274e-2, 0.02),
    ],
    ids=["box", "sphere", "capsule", "cylinder", "ellipsoid"],
)
def test_primitive_has_its_extent_and_volume_on_body_0(add, expected_extent, expected_volume, rel):
    (mesh,) = build(add)
    assert extent(mesh) == pytest.approx(expected_extent, rel=0.01)
    assert volume(mesh) == pytest.approx(expected_volume, rel=rel)
    assert mesh.body == 0


def test_mesh_shape_has_its_scale_pose_and_color():
    corners = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], dtype=np.float32)
    faces = np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])
    source = newton.Mesh(corners, faces.ravel(), compute_inertia=False)
    place = wp.transform(wp.vec3(10.0, 0.0, 0.0), QUARTER_TURN)
    (mesh,) = build(
        lambda b, i: b.add_shape_mesh(i, xform=place, mesh=source, scale=(1.0, 2.0, 3.0), color=(0.2, 0.4, 0.6))
    )
    # a tetrahedron of edges 1, 2, 3 m, turned about z (x to y, y to -x) and moved by 10 m along x
    assert mesh.vertices.min(axis=0) == pytest.approx([8.0, 0.0, 0.0], abs=1e-5)
    assert mesh.vertices.max(axis=0) == pytest.approx([10.0, 1.0, 3.0], abs=1e-5)
    assert volume(mesh) == pytest.approx(1.0, rel=1e-5)
    assert mesh.color == pytest.approx((0.2, 0.4, 0.6))


def test_heightfield_has_its_heights_at_its_nodes_facing_up():
    heights = np.array([[0.0, 1.0, 2.0], [10.0, 11.0, 12.0]])  # rows follow y, columns x
    field = newton.Heightfield(data=heights, nrow=2, ncol=3, hx=3.0, hy=0.5)
    (mesh,) = build(add_ground=lambda b: b.add_shape_heightfield(heightfield=field, label="ground"))
    expected = {(-3, -0.5, 0), (0, -0.5, 1), (3, -0.5, 2), (-3, 0.5, 10), (0, 0.5, 11), (3, 0.5, 12)}
    assert {tuple(np.round(vertex, 5).tolist()) for vertex in mesh.vertices} == expected
    assert len(mesh.triangles) == 4  # two for each of two cells
    assert (mesh.normals[:, 2] > 0.0).all()
