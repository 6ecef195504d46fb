"""Newton's solver interface of SolverJumper: refusals, changed parameters, reset, divergence, states and bodies."""

import newton
import numpy as np
import pytest
import warp as wp
from newton import ModelFlags, StateFlags

from columns import COORDS, DOFS, MOTOR_DOFS, X, Z
from jumper_warp.utils.errors import InputError
from simulation_helpers import loop_gap, simulation
from solver_helpers import BODIES, KNEE_V

DT = 1.0 / 480.0


def launch(sim):
    """Reset all worlds to a start 0.2 m above standing at 1.5 m/s along x: every parameter affects the motion."""
    sim.solver.reset(sim.state)
    q, qd = sim.joint_q().copy(), sim.joint_qd().copy()
    q[:, Z] += 0.2
    qd[:, X] = 1.5
    sim.state.joint_q.assign(q.ravel())
    sim.state.joint_qd.assign(qd.ravel())


def command(sim, step):
    """Command all motors; in policy steps 10 to 19 the outer ones beyond their stop at 140 degrees."""
    degrees = np.tile([10.0, 160.0 if 10 <= step < 20 else 60.0, 50.0], 4)
    sim.target.assign(np.repeat(np.radians(degrees)[:, None], sim.num_worlds, axis=1).astype(np.float32))


def trajectory(sim, steps=30):
    """Return joint_q of each policy step after `launch`, (steps, num_worlds, 43)."""
    launch(sim)
    motion = []
    for step in range(steps):
        command(sim, step)
        sim.step()
        motion.append(sim.joint_q().copy())
    return np.array(motion)


@pytest.mark.parametrize(("argument", "value"), [("dt", -DT), ("substeps", 0), ("tolerance", float("inf"))])
def test_simulation_refuses(argument, value):
    with pytest.raises(ValueError, match=f"{argument} must be"):
        simulation(1, **{argument: value})


CHANGES = [  # array, rows per world, rows to change (None: world 1's shapes), factor, flag to notify
    ("body_mass", BODIES, slice(0, 1), 1.3, ModelFlags.BODY_INERTIAL_PROPERTIES),
    ("body_com", BODIES, slice(0, 1), 3.0, ModelFlags.BODY_INERTIAL_PROPERTIES),
    ("body_inertia", BODIES, slice(1, 21), 2.0, ModelFlags.BODY_INERTIAL_PROPERTIES),
    ("joint_armature", DOFS, MOTOR_DOFS, 3.0, ModelFlags.JOINT_DOF_INERTIAL_PROPERTIES),
    ("joint_armature", DOFS, MOTOR_DOFS, 3.0, ModelFlags.JOINT_DOF_PROPERTIES),
    ("joint_friction", DOFS, MOTOR_DOFS, 10.0, ModelFlags.JOINT_DOF_FORCE_PROPERTIES),
    ("joint_damping", DOFS, KNEE_V, 0.1, ModelFlags.JOINT_DOF_FORCE_PROPERTIES),
    ("joint_effort_limit", DOFS, KNEE_V, 0.2, ModelFlags.JOINT_DOF_FORCE_PROPERTIES),
    ("joint_limit_upper", DOFS, MOTOR_DOFS, 0.6, ModelFlags.JOINT_DOF_PROPERTIES),
    ("shape_material_mu", None, None, 0.5, ModelFlags.SHAPE_PROPERTIES),
    ("gravity", 1, slice(0, 1), 0.5, ModelFlags.MODEL_PROPERTIES),
]


@pytest.fixture(scope="module")
def pair():
    """A simulation of two worlds, and its `trajectory` with unchanged parameters."""
    sim = simulation(2)
    return sim, trajectory(sim)


@pytest.mark.parametrize("change", CHANGES, ids=[f"{c[0]}-{c[4].name}" for c in CHANGES])
def test_changed_parameter_acts_after_notification_and_in_its_world_only(pair, change):
    sim, before = pair
    name, rows, which, factor, flag = change
    array = getattr(sim.model, name)
    original = array.numpy().copy()
    values = original.copy()
    if name == "shape_material_mu":
        values[[label.startswith("world_1/") for label in sim.model.shape_label]] *= factor
    else:
        values[rows : 2 * rows][which] *= factor
    array.assign(values)
    try:
        unnotified = trajectory(sim)
        sim.solver.notify_model_changed(flag)
        after = trajectory(sim)
    finally:
        array.assign(original)
        sim.solver.notify_model_changed(flag)
    if name != "body_com":  # joint_qd itself refers to the model's com
        assert np.array_equal(unnotified, before)
    assert np.array_equal(after[:, 0], before[:, 0])
    assert np.abs(after[:, 1, :27] - before[:, 1, :27]).max() > 1e-3


def test_reset_with_flag_none_clears_contact_forces_but_keeps_the_state():
    sim = simulation(2)
    trajectory(sim, steps=25)
    moved = sim.joint_q().copy()
    assert sim.paw_force.numpy().any()
    sim.solver.reset(sim.state, flags=StateFlags.NONE)
    assert np.array_equal(sim.joint_q(), moved)
    assert not sim.paw_force.numpy().any()


def test_diverged_world_is_frozen_until_reset_and_others_are_unaffected():
    sims = [simulation(3), simulation(3)]
    for sim in sims:
        launch(sim)
        command(sim, 0)
        for _ in range(3):
            sim.step()
    broken, intact = sims
    rates = broken.joint_qd().copy()
    rates[1, 7] = np.nan
    broken.state.joint_qd.assign(rates.ravel())
    for _ in range(20):
        broken.step()
        intact.step()
    assert broken.solver.diverged.numpy().tolist() == [0, 1, 0]
    assert broken.joint_q()[1] == pytest.approx(broken.model.joint_q.numpy().reshape(3, COORDS)[1], abs=1e-6)
    assert not broken.joint_qd()[1].any()
    for world in (0, 2):
        assert np.array_equal(broken.joint_q()[world], intact.joint_q()[world])
        assert np.array_equal(broken.joint_qd()[world], intact.joint_qd()[world])
    mask = wp.array([False, True, False, False], dtype=wp.bool, device="cpu")
    for sim in sims:
        sim.solver.reset(sim.state, mask)
        sim.step()
        sim.step()
    assert not broken.solver.diverged.numpy().any()
    assert np.array_equal(broken.joint_q(), intact.joint_q())


def test_runs_are_bitwise_repeatable(pair):
    sim, before = pair
    assert np.array_equal(trajectory(sim), before)
    assert np.array_equal(trajectory(simulation(2)), before)


def test_explicit_torques_match_closed_loop_motors():
    driven, explicit = simulation(2), simulation(2)
    for sim in (driven, explicit):
        launch(sim)
    command(driven, 12)
    driven.filter_targets()
    largest = 0.0  # [N m]
    for _ in range(60):
        before = driven.joint_q().copy(), driven.joint_qd().copy()
        driven.physics_step()
        joint_f = np.zeros((2, DOFS), dtype=np.float32)
        joint_f[:, MOTOR_DOFS] = driven.torque.numpy().T
        explicit.control.joint_f.assign(joint_f.ravel())
        explicit.state.joint_q.assign(before[0].ravel())
        explicit.state.joint_qd.assign(before[1].ravel())
        explicit.solver.step(explicit.state, explicit.state, explicit.control, None, DT)
        assert explicit.joint_qd() == pytest.approx(driven.joint_qd(), abs=1e-5)
        assert explicit.joint_q() == pytest.approx(driven.joint_q(), abs=1e-5)
        largest = max(largest, np.abs(joint_f).max())
    assert largest > 10.0


def test_refuses_a_state_with_gradients():
    sim = simulation(1)
    out = sim.model.state()
    out.joint_q.requires_grad = True
    with pytest.raises(InputError, match=r"no gradients on Warp's tape; use jumper_warp\.diff\.rollout"):
        sim.solver.step(sim.state, out, None, None, DT)


def test_step_does_not_write_its_input():
    sim = simulation(2)
    launch(sim)
    out = sim.model.state()
    before = sim.joint_q().copy(), sim.joint_qd().copy()
    sim.solver.step(sim.state, out, None, None, DT)
    assert np.array_equal(sim.joint_q(), before[0])
    assert np.array_equal(sim.joint_qd(), before[1])
    sim.solver.reset(sim.state, flags=StateFlags.NONE)
    sim.solver.step(sim.state, sim.state, None, None, DT)
    assert np.array_equal(sim.joint_q().ravel(), out.joint_q.numpy())


def test_bodies_match_newton_kinematics(pair):
    sim, _ = pair
    trajectory(sim, steps=15)
    state = sim.model.state()
    newton.eval_fk(sim.model, sim.state.joint_q, sim.state.joint_qd, state)
    found, expected = sim.state.body_q.numpy(), state.body_q.numpy()
    expected[:, 3:] *= np.sign((found[:, 3:] * expected[:, 3:]).sum(axis=1))[:, None]
    assert found == pytest.approx(expected, abs=2e-6)
    assert sim.state.body_qd.numpy() == pytest.approx(state.body_qd.numpy(), abs=1e-4)
    assert loop_gap(sim).max() < 1e-6
