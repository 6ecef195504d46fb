"""Scene of the viewer in the browser: poses of links, followed point, goals, and files of meshes."""

import io

import numpy as np
import pytest
import trimesh
import viser

from jumper_warp.robot.model import build_model
from jumper_warp.sim.simulation import Simulation
from jumper_warp.viz.shapes import shape_meshes
from jumper_warp.viz.viser import ViserScene, glb_of


@pytest.fixture(scope="module")
def server():
    """Yield a server of viser on a free port of the loopback address."""
    server = viser.ViserServer("127.0.0.1", 0, verbose=False)
    yield server
    server.stop()


@pytest.fixture(scope="module")
def shapes():
    """Return the meshes of one robot on a plane."""
    return shape_meshes(build_model(1, device="cpu", mujoco=False), (0,))


def test_each_link_has_one_node_with_its_pose(server, shapes):
    scene = ViserScene(server.scene, shapes, robots=2)
    poses = np.concatenate(2 * [Simulation(1, device="cpu").links()[0]])
    poses[1, :, 1] += 2.0
    scene.update(poses)
    assert len(scene.links) == 21
    np.testing.assert_array_equal(scene.links[3].batched_positions, poses[:, 3, :3])
    np.testing.assert_array_equal(scene.links[3].batched_wxyzs[:, 0], poses[:, 3, 6])


def test_links_are_relative_to_the_followed_point(server, shapes):
    scene = ViserScene(server.scene, shapes)
    poses = Simulation(1, device="cpu").links()[0]
    poses[..., 0] += 30.3
    scene.follow(np.array([30.3, 0.0, 0.0]))
    scene.update(poses)
    np.testing.assert_allclose(scene.links[0].batched_positions[0, :2], [0.0, 0.0], atol=1e-5)
    assert scene.links[0].name == "/link_0"  # below ROOT it would move with the ground


def test_glb_has_linear_colors_and_the_surface(shapes):
    shape = next(shape for shape in shapes if shape.body == 0)
    loaded = trimesh.load(io.BytesIO(glb_of([shape])), file_type="glb")
    mesh = next(iter(loaded.geometry.values()))
    np.testing.assert_allclose(mesh.bounds, [shape.vertices.min(0), shape.vertices.max(0)], atol=1e-6)
    color = np.array(mesh.visual.material.baseColorFactor[:3]) / 255.0
    np.testing.assert_allclose(color, np.array(shape.color) ** 2.2, atol=0.01)
