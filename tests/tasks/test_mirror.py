"""Observations of mirrored robots: the second half of an environment's worlds is the mirror image of the first half."""

import dataclasses
from typing import Any

import numpy as np
import pytest
import torch
import warp as wp

from columns import ANG_VEL, LIN_VEL, POS, QUAT
from jumper_warp.kernels.mdp.view import RobotView
from jumper_warp.kernels.velocity import observations as velocity
from jumper_warp.registry import make_task
from jumper_warp.robot.terrain import TerrainCfg, single_tile
from jumper_warp.tasks.cfg import ObservationsCfg
from jumper_warp.tasks.mirror import mirror_image, mirror_of
from jumper_warp.tasks.terms import ObservationTerm
from jumper_warp.utils.errors import InputError
from velocity_helpers import edit, states_of, walking_env

HALF = 8  # worlds
LEGS = [1, 0, 3, 2]  # FL, FR, BL, BR with sides swapped
MOTORS = [3 * leg + j for leg in LEGS for j in range(3)]
BODIES = 21
SWAPPED_COORDS = [7 + 5 * leg + j for leg in LEGS for j in range(5)]  # of the 20 hinges
SWAPPED_DOFS = [column - 1 for column in SWAPPED_COORDS]
FLIP, SPIN = np.array([1.0, -1.0, 1.0]), np.array([-1.0, 1.0, -1.0])  # signs of vectors and of rotation vectors
QUAT_SIGNS = np.array([-1.0, 1.0, -1.0, 1.0])  # of xyzw


def task():
    """Return velocity-rough with a gait clock, whose observations have the terms of all velocity tasks."""
    rough, gait_phase = make_task("velocity-rough"), ObservationTerm(velocity.gait_phase)
    return dataclasses.replace(
        rough,
        observations=ObservationsCfg(
            actor=(*rough.observations.actor, gait_phase), critic=(*rough.observations.critic, gait_phase)
        ),
    )


def with_mirrored_half(values, mirror):
    """Return a copy of values (2 * HALF worlds, ...) whose second half is mirror(first half)."""
    values = values.copy()
    values[HALF:] = mirror(values[:HALF])
    return values


def mirror_array(array, shape, mirror, worlds_last=False):
    """Write mirror(first half) into the second half of a Warp array, (n, 2 * HALF) if worlds_last, else `shape`."""
    values = array.numpy()
    values = np.moveaxis(values, 1, 0) if worlds_last else values.reshape(shape)
    values = with_mirrored_half(values, mirror)
    array.assign(
        np.ascontiguousarray(np.moveaxis(values, 0, 1)) if worlds_last else values.reshape(array.numpy().shape)
    )


@pytest.fixture(scope="module")
def reflection():
    """The task, and observations (2 * HALF, columns) of both halves after some steps, by group."""
    ground = single_tile(TerrainCfg(tile=6.0, cell=0.1), "slope")
    env = walking_env(2 * HALF, task=task(), ground=ground, randomize=True)
    rng, n = torch.Generator().manual_seed(2), 2 * HALF
    for _ in range(12):
        env.step(0.3 * torch.randn((n, 12), generator=rng))
    robot, parameters = env.robot, env.parameters
    mirror_array(
        robot.joint_q,
        (n, 43),
        lambda q: np.concatenate([q[:, POS] * FLIP, q[:, QUAT] * QUAT_SIGNS, q[:, SWAPPED_COORDS], q[:, 27:]], axis=1),
    )
    mirror_array(
        robot.joint_qd,
        (n, 38),
        lambda v: np.concatenate([v[:, LIN_VEL] * FLIP, v[:, ANG_VEL] * SPIN, v[:, SWAPPED_DOFS], v[:, 26:]], axis=1),
    )
    robot.body_f.assign(np.random.default_rng(1).normal(size=(n * BODIES, 6)))
    mirror_array(robot.body_f, (n, BODIES, 6), lambda f: f * np.concatenate([FLIP, SPIN]))
    mirror_array(robot.body_com, (n, BODIES, 3), lambda c: c * FLIP)
    for name in ("contact_time", "air_time", "touchdown_speed", "peak_force", "paw_height", "paw_force"):
        mirror_array(getattr(robot, name), None, lambda x: x[:, LEGS], worlds_last=True)
    for name in ("action", "prev_action", "prev_prev_action", "torque", "joint_offset"):
        mirror_array(getattr(robot, name), None, lambda x: x[:, MOTORS], worlds_last=True)
    for array in (parameters.gain_ratio, parameters.motors.no_load_speed):
        mirror_array(array, None, lambda x: x[:, MOTORS], worlds_last=True)
    for array in (parameters.latency, parameters.static_ratio):
        mirror_array(array, (n,), lambda x: x)
    mass = parameters.body_mass.numpy().reshape(n, BODIES)
    parameters.body_mass.assign(with_mirrored_half(mass, lambda x: x).ravel())
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
    return env.task, {"actor": env.obs.numpy().copy(), "critic": env.critic_obs.numpy().copy()}


@pytest.mark.parametrize("group", ["actor", "critic"])
def test_observation_of_a_mirrored_robot_is_the_mirror_image(reflection, group):
    env_task, observations = reflection
    mirror = mirror_of(env_task, group)
    first, second = observations[group][:HALF], observations[group][HALF:]
    for name, (begin, end) in env_task.layout(group).items():
        expected = (mirror.signs * first[:, mirror.order])[:, begin:end]
        np.testing.assert_allclose(second[:, begin:end], expected, atol=2e-5, err_msg=name)
        assert np.abs(first[:, begin:end]).max() > 0.0, f"{name} is all zero"


def test_mirroring_twice_is_the_identity():
    """A mirror image is x -> signs * x[order], of observations and of actions."""
    for mirror in (mirror_of(task(), "actor"), mirror_of(task(), "critic"), mirror_image(task(), "action")):
        x = np.random.default_rng(0).normal(size=len(mirror.order))
        once = mirror.signs * x[mirror.order]
        np.testing.assert_allclose(mirror.signs * once[mirror.order], x)


@pytest.mark.parametrize("wrong", [("velocity",), ("action", "up-down"), ("observation", "front-back")])
def test_refuses_an_unknown_mirror_image(wrong):
    with pytest.raises(
        InputError, match=r"expected observation or action, left-right|front-back image of command is not"
    ):
        mirror_image(task(), *wrong)


@wp.func
def sideways(robot: RobotView, state: Any) -> wp.vec4:
    """Return zeros."""
    return wp.vec4(0.0)


def test_refuses_a_mirror_image_that_is_not_its_own_inverse():
    ObservationTerm(sideways, mirror=(2, 1, -3, 4))
    for wrong in ((1, 2, 3), (2, 3, 1, 4), (-2, 1, 3, 4), (0, 1, 2, 3), (1, 2, 3, 5)):
        with pytest.raises(InputError, match="ObservationTerm sideways: mirror must have 1 to 4, each once"):
            ObservationTerm(sideways, mirror=wrong)


def test_only_columns_that_are_mirrored_as_legs_have_names_of_legs():
    def ends(**mirror):
        return [name.removeprefix("sideways_") for name in ObservationTerm(sideways, **mirror).columns]

    assert ends() == ends(mirror=(1, -2, 3, -4)) == ["x", "y", "z", "w"]
    assert ends(mirror=(2, 1, 4, 3)) == ["FL", "FR", "BL", "BR"]
