"""A mirrored robot sees the mirror image: two halves of an environment, the second made the first's reflection."""

import dataclasses

import numpy as np
import pytest
import torch

from jumper_warp.kernels.mdp import observations as obs
from jumper_warp.kernels.velocity import observations as velocity
from jumper_warp.registry import make_task
from jumper_warp.robot.terrain import TerrainCfg, single_tile
from jumper_warp.tasks.mirror import LEGS, MOTORS, mirror_of, mirror_of_action
from jumper_warp.tasks.terms import ObservationTerm
from jumper_warp.utils.errors import InputError
from velocity_helpers import edit, states_of, walking_env

HALF = 8
BODIES = 21
SWAPPED = [5 * leg + j for leg in LEGS for j in range(5)]
FLIP, SPIN = np.array([1.0, -1.0, 1.0]), np.array([-1.0, 1.0, -1.0])
QUAT = np.array([-1.0, 1.0, -1.0, 1.0])


def task():
    """The task on rough ground with a clock, so that every term of all velocity tasks is there."""
    rough, step_count = make_task("velocity-rough"), ObservationTerm(velocity.step_count)
    return dataclasses.replace(rough, policy=(*rough.policy, step_count), critic=(*rough.critic, step_count))


def reflected(values, change):
    """Write the change of the first half of the worlds, which are the first axis, into the second."""
    values = values.copy()
    values[HALF:] = change(values[:HALF])
    return values


def change(array, shape, how, worlds_last=False):
    """Reflect an array of the environment; shape: of its values with worlds as the first axis."""
    values = array.numpy()
    values = np.moveaxis(values, 1, 0) if worlds_last else values.reshape(shape)
    values = reflected(values, how)
    array.assign(
        np.ascontiguousarray(np.moveaxis(values, 0, 1)) if worlds_last else values.reshape(array.numpy().shape)
    )


@pytest.fixture(scope="module")
def reflection():
    """Observations of both halves after some steps, by group."""
    ground = single_tile(TerrainCfg(tile=6.0, cell=0.1), "slope")
    env = walking_env(2 * HALF, task=task(), ground=ground, randomize=True)
    rng, n = torch.Generator().manual_seed(2), 2 * HALF
    for _ in range(12):
        env.step(0.3 * torch.randn((n, 12), generator=rng))
    robot, parameters = env.robot, env.parameters
    change(
        robot.joint_q,
        (n, 43),
        lambda q: np.concatenate([q[:, :3] * FLIP, q[:, 3:7] * QUAT, q[:, 7:27][:, SWAPPED], q[:, 27:]], axis=1),
    )
    change(
        robot.joint_qd,
        (n, 38),
        lambda v: np.concatenate([v[:, :3] * FLIP, v[:, 3:6] * SPIN, v[:, 6:26][:, SWAPPED], v[:, 26:]], axis=1),
    )
    robot.body_f.assign(np.random.default_rng(1).normal(size=(n * BODIES, 6)))
    change(robot.body_f, (n, BODIES, 6), lambda f: f * np.concatenate([FLIP, SPIN]))
    change(robot.body_com, (n, BODIES, 3), lambda c: c * FLIP)
    for name in ("contact_time", "air_time", "touchdown_speed", "peak_force", "paw_height", "paw_force"):
        change(getattr(robot, name), None, lambda x: x[:, LEGS], worlds_last=True)
    for name in ("action", "prev_action", "prev_prev_action", "torque", "joint_offset"):
        change(getattr(robot, name), None, lambda x: x[:, MOTORS], worlds_last=True)
    for array in (parameters.gain_ratio, parameters.motors.no_load_speed):
        change(array, None, lambda x: x[:, MOTORS], worlds_last=True)
    for array in (parameters.latency, parameters.static_ratio):
        change(array, (n,), lambda x: x)
    mass = parameters.body_mass.numpy().reshape(n, BODIES)
    parameters.body_mass.assign(reflected(mass, lambda x: x).ravel())
    mu, paws = parameters.shape_mu.numpy().copy(), parameters.paw_shapes.numpy().reshape(n, 4)
    mu[paws[HALF:]] = mu[paws[:HALF]]
    parameters.shape_mu.assign(mu)
    state = states_of(env)
    edit(
        env,
        slice(HALF, None),
        command=state["command"][:HALF] * [1.0, -1.0, -1.0],
        recent_steps=state["recent_steps"][:HALF][:, LEGS],
        phase=np.mod(state["phase"][:HALF] + 0.5, 1.0),
        command_steps=state["command_steps"][:HALF],
    )
    parameters.observation_latency.zero_()
    env.episodes.diverged.zero_()
    env.episodes.history_reset.fill_(1)
    env.stages()["observe"]()
    return env.task, {"policy": env.obs.numpy().copy(), "critic": env.critic_obs.numpy().copy()}


@pytest.mark.parametrize("group", ["policy", "critic"])
def test_mirrored_robot_sees_the_mirror_image(reflection, group):
    env_task, seen = reflection
    mirror = mirror_of(env_task, group)
    first, second = seen[group][:HALF], seen[group][HALF:]
    for name, (a, b) in env_task.layout(group).items():
        np.testing.assert_allclose(
            second[:, a:b], (mirror.signs * first[:, mirror.order])[:, a:b], atol=2e-5, err_msg=name
        )
        assert np.abs(first[:, a:b]).max() > 0.0, f"{name} tells nothing"


def test_mirroring_twice_gives_back_what_was():
    for mirror in (mirror_of(task(), "policy"), mirror_of(task(), "critic"), mirror_of_action()):
        x = np.random.default_rng(0).normal(size=len(mirror.order))
        once = mirror.signs * x[mirror.order]
        np.testing.assert_allclose(mirror.signs * once[mirror.order], x)


def test_term_whose_image_is_not_known_is_refused():
    other = dataclasses.replace(make_task("velocity-flat"), critic=(ObservationTerm(obs.drawn_push),))
    with pytest.raises(InputError, match="mirror image of drawn_push is not known"):
        mirror_of(other, "critic")
