"""Randomised parameters of a world: their ranges, and their effect on solver, motors and environment."""

import dataclasses
import math

import numpy as np
import pytest

from columns import MOTOR_DOFS
from jumper_warp.kernels.mdp import parameters
from jumper_warp.tasks.randomization import RandomizationCfg
from randomization_helpers import ALL, HELD, OFF, PAPER, ROWS, fills, own_model, randomized, read


@pytest.fixture(scope="module")
def nominal():
    """Return the parameters with every row off."""
    return read(randomized(OFF))


@pytest.fixture(scope="module")
def drawn():
    """Return the parameters of 512 worlds with every row on."""
    return read(randomized(RandomizationCfg(observation_latency=(0.0, 16.0), **HELD), 512))


def test_parameters_without_randomisation_are_those_of_the_description(nominal):
    first = {name: values[..., :1] for name, values in nominal.items()}
    for name, values in nominal.items():
        np.testing.assert_array_equal(values, np.broadcast_to(first[name], values.shape), err_msg=name)
    for name in ("joint_offset", "latency", "observation_latency", "push_force", "push_torque"):
        assert not nominal[name].any(), name
    np.testing.assert_allclose(nominal["static_friction"], nominal["dynamic_friction"])
    assert nominal["base_mass"][0] == pytest.approx(6.431, abs=2e-3)
    assert nominal["base_mass"][0] + nominal["link_mass"][:, 0].sum() == pytest.approx(14.5, abs=0.01)
    np.testing.assert_allclose(nominal["com_shift"][:, 0], [-0.0094, 0.0, 0.0111], atol=1e-5)
    np.testing.assert_allclose(nominal["armature"][:3, 0], [4.69e-3, 4.14e-3, 4.14e-3], rtol=2e-3)
    np.testing.assert_allclose(nominal["kp"], 17.0)
    np.testing.assert_allclose(nominal["kd"][:3, 0], [1.8, 0.8, 0.8], rtol=1e-6)


@pytest.mark.parametrize("row", ROWS)
def test_a_row_reaches_the_solver_and_fills_its_range(drawn, nominal, row):
    reference = {name: values[..., :1] for name, values in nominal.items()}
    assert fills(ROWS[row](drawn, reference), *PAPER[row])


def test_samples_are_independent_between_links_motors_axes_and_rows(drawn, nominal):
    """Only the paws of a world share their friction."""
    rows = [
        drawn["base_mass"][None], drawn["link_mass"], drawn["com_shift"], drawn["kp"], drawn["kd"],
        drawn["no_load_speed"], drawn["armature"], drawn["motor_friction"], drawn["joint_offset"], drawn["push_force"],
        drawn["push_torque"], drawn["dynamic_friction"][:1], drawn["latency"][None], drawn["observation_latency"][None],
    ]  # fmt: skip
    matrix = np.corrcoef(np.concatenate(rows))
    assert np.abs(matrix - np.eye(len(matrix))).max() < 5.0 / math.sqrt(512)
    np.testing.assert_array_equal(drawn["dynamic_friction"], drawn["dynamic_friction"][:1].repeat(4, 0))


def test_static_friction_is_not_below_dynamic(drawn):
    assert (drawn["static_friction"] >= drawn["dynamic_friction"] * (1.0 - 1e-6)).all()


def test_mass_and_inertia_of_a_link_have_the_same_scale(drawn, nominal):
    scale = drawn["link_mass"] / nominal["link_mass"][:, :1]
    expected = nominal["link_moments"][..., :1] * scale[:, None, :]
    np.testing.assert_allclose(drawn["link_moments"], expected, rtol=1e-4, atol=1e-8)


AFFECTED = {
    "static_friction": ["static_friction"],
    "dynamic_friction": ["dynamic_friction", "static_friction"],
    **{row: [row] for row in ("no_load_speed", "cutoff_speed", "push_force", "push_torque")},
}
"""Parameters changed by each row that shares its event with another row, by row."""


@pytest.mark.parametrize("row", AFFECTED)
def test_a_row_that_shares_its_event_changes_no_other_parameter(nominal, row):
    found = read(randomized(dataclasses.replace(OFF, **{row: ALL[row]}), 4))
    changed = [name for name in found if not np.array_equal(found[name], nominal[name][..., :4])]
    assert set(changed) <= set(AFFECTED[row]) and AFFECTED[row][0] in changed


@pytest.mark.parametrize("row", AFFECTED)
def test_parameters_of_a_row_that_is_off_are_nominal(nominal, row):
    found = read(randomized(dataclasses.replace(RandomizationCfg(**ALL, **HELD), **{row: None}), 4))
    if row == "static_friction":
        np.testing.assert_allclose(found[row], found["dynamic_friction"])
    elif row == "dynamic_friction":
        np.testing.assert_allclose(found[row], np.broadcast_to(found[row][:1, :1], found[row].shape))
    else:
        np.testing.assert_array_equal(found[row], nominal[row][..., :4])


@pytest.mark.parametrize("row", sorted(set(ALL) - set(AFFECTED)))
def test_every_other_row_has_its_own_event(row):
    (alone,) = dataclasses.replace(OFF, **{row: ALL[row]}).events()
    assert alone.func is getattr(parameters, "action_latency" if row == "latency" else row)
    every = RandomizationCfg(**ALL, **HELD)
    rest = dataclasses.replace(every, **{row: None}).events()
    assert [event.func for event in rest] == [event.func for event in every.events() if event.func is not alone.func]


# ---------------------------------------------------------------- MuJoCo


def test_randomised_parameters_reach_mujoco():
    env = randomized(RandomizationCfg(), 2, solver="mujoco")
    for _ in range(2):
        model, solver, found = env.sim.model, env.sim.solver.mjw_model, own_model(env)
        bodies = {name: getattr(model, name).numpy().reshape(2, 21, -1) for name in ("body_mass", "body_com")}
        np.testing.assert_allclose(found["body_mass"][:, 1:], bodies["body_mass"][..., 0], rtol=1e-6)
        np.testing.assert_allclose(found["body_ipos"][:, 1:], bodies["body_com"], atol=1e-7)
        # MuJoCo stores principal moments in another order
        inertia = np.linalg.eigvalsh(model.body_inertia.numpy().astype(float)).reshape(2, 21, 3)
        np.testing.assert_allclose(np.sort(found["body_inertia"][:, 1:], axis=2), inertia, rtol=1e-3, atol=1e-9)
        for world in range(2):
            for name, least, wanted in (
                ("dof_armature", 1e-3, model.joint_armature), ("dof_frictionloss", 1e-6, model.joint_friction),
            ):  # fmt: skip
                row = found[name][world]
                motors = wanted.numpy().reshape(2, -1)[world][MOTOR_DOFS]
                np.testing.assert_allclose(np.sort(row[row > least]), np.sort(motors), rtol=1e-5)
            paws = model.shape_material_mu.numpy()[env.parameters.paw_shapes.numpy().reshape(2, 4)[world]]
            assert np.isclose(found["geom_friction"][world, :, 0][:, None], paws).any(axis=0).all()
        assert solver is env.sim.solver.mjw_model
        env.reset()
        assert all((found[name] != values).any() for name, values in own_model(env).items())
