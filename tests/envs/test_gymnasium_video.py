"""Images and videos of Gymnasium environments."""

import gymnasium
import numpy as np
import pytest
import torch
from scipy.interpolate import RegularGridInterpolator

from columns import XY
from jumper_warp.envs.camera import WorldCamera
from jumper_warp.envs.env import Env
from jumper_warp.envs.gymnasium import GymVectorEnv
from jumper_warp.gym import env_id
from jumper_warp.registry import make_task
from jumper_warp.robot.grounds import BlockCfg, uneven

SIZE = (160, 120)  # [px] width and height
ACTIONS = np.random.default_rng(0).uniform(-0.5, 0.5, (20, 2, 12)).astype(np.float32)


def vector(task="vertical-jump", num_envs=2, **arguments):
    """Return an environment of a task that draws small images."""
    options = {"render_mode": "rgb_array", "render_size": SIZE, "device": "cpu", "seed": 3} | arguments
    return gymnasium.make_vec(env_id(task), num_envs=num_envs, **options)


def brown(image):
    """Return the number of pixels in the color of blocks."""
    red, green, blue = image.astype(int).transpose(2, 0, 1)
    return int(((red > green + 15) & (green > blue + 15) & (green > 90)).sum())


# ---------------------------------------------------------------- videos


# ---------------------------------------------------------------- images


@pytest.mark.parametrize("tensors", [False, True])
def test_drawing_does_not_change_the_simulation(tensors):
    drawn, plain = (vector("horizontal-jump", tensors=tensors, render_mode=mode) for mode in ("rgb_array", None))
    actions = torch.from_numpy(ACTIONS) if tensors else ACTIONS
    for envs in (drawn, plain):
        envs.reset(seed=5)
    for action in actions:
        images, results = drawn.render(), [envs.step(action) for envs in (drawn, plain)]
        assert [(image.shape, image.dtype) for image in images] == [((*SIZE[::-1], 3), np.uint8)] * 2
        for a, b in zip(results[0][:4], results[1][:4], strict=True):
            np.testing.assert_array_equal(a, b)
    for name in ("joint_q", "joint_qd", "body_q", "body_qd"):
        states = [getattr(envs.env.sim.state, name).numpy() for envs in (drawn, plain)]
        np.testing.assert_array_equal(*states)
    drawn.close()


def test_each_world_shows_its_own_block_also_after_a_change():
    block = BlockCfg((0.6, 0.0), half=np.array([[0.15, 0.3], [0.05, 0.1]]))
    envs = GymVectorEnv(
        Env(make_task("vertical-jump"), 2, device="cpu", block=block), render_mode="rgb_array", render_size=SIZE
    )
    envs.reset(seed=1)
    large, small = (brown(image) for image in envs.render())
    assert large > 2 * small > 100
    blocks = envs.env.sim.dynamics.robot.ground.blocks
    values = blocks.numpy()
    values["exists"][0], values["half"][1] = 0, values["half"][0]
    blocks.assign(values)
    gone, grown = (brown(image) for image in envs.render())
    assert gone < small / 2 and grown == pytest.approx(large, rel=0.2)
    envs.close()


@pytest.mark.parametrize("point", [(0.3, -0.6), (1.9, 1.7)])
def test_drawn_heightfield_equals_the_simulated_one(point):
    field = uneven(0.08, seed=2, cell=0.03)
    env = Env(make_task("vertical-jump"), 1, device="cpu", ground=field)
    camera = WorldCamera(env.sim, 1, SIZE)
    (mesh,) = camera._scenery_shapes(np.array([[*point, 0.0, 0.0, 0.0]]))
    vertices = mesh.vertices.astype(float) + [*point, 0.0]
    heights = field.min_z + field.data * (field.max_z - field.min_z)
    axes = np.linspace(-field.hy, field.hy, field.nrow), np.linspace(-field.hx, field.hx, field.ncol)
    inside = np.abs(vertices[:, XY]).max(axis=1) < field.hx
    expected = RegularGridInterpolator(axes, heights)(vertices[inside][:, 1::-1])
    np.testing.assert_allclose(vertices[inside, 2], expected, atol=1.0e-4)
    assert inside.sum() > 1000 and np.ptp(vertices[inside, 2]) > 0.05
    assert np.isfinite(vertices).all() and np.abs(vertices[:, XY] - point).max() == pytest.approx(5.0, abs=0.1)
