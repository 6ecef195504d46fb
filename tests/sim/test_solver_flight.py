"""Free flight of SolverJumper against Pinocchio, and drift of energy and momentum."""

import importlib

import numpy as np
import pytest
import warp as wp
from scipy.spatial.transform import Rotation

from columns import DOFS, MOTOR_DOFS
from jumper_warp.robot.model import leg_geometry_array, load_description
from jumper_warp.sim.dynamics import kernel_modules
from pinocchio_model import build_pinocchio
from solver_helpers import KNEE_V, Flight, Reference, bare_model, random_states

GRAVITY = 9.81


def loaded_model(worlds, seed):
    """Return a model whose base mass, inertia and centre of mass differ between worlds."""
    rng = np.random.default_rng(seed)
    model = bare_model(worlds)
    mass, com, inertia = (a.numpy() for a in (model.body_mass, model.body_com, model.body_inertia))
    scale = rng.uniform(0.8, 1.5, worlds).astype(np.float32)
    mass[::21] *= scale
    inertia[::21] *= scale[:, None, None]
    com[::21] += rng.uniform(-0.05, 0.05, (worlds, 3)).astype(np.float32)
    model.body_mass.assign(mass)
    model.body_com.assign(com)
    model.body_inertia.assign(inertia)
    return model


@pytest.fixture(scope="module")
def forced():
    """Model of 2000 payloads, states, torques (n, 12) [N m], and Pinocchio's accelerations (n, 18), body axes."""
    n = 2000
    model, states = loaded_model(n, 1), random_states(n, 2)
    torque = np.random.default_rng(3).uniform(-18.0, 18.0, (n, 12)).astype(np.float32).astype(float)
    reference = Reference(model)
    expected = np.empty((n, 18))
    for i in range(n):
        reference.use_world(i)
        expected[i] = reference.accelerations(states, i, torque[i])
    return model, states, torque, expected


@pytest.mark.parametrize(("double", "dt", "tolerance"), [(False, 1e-3, 1e-4), (True, 1e-6, 1e-9)], ids=["f32", "f64"])
def test_accelerations_match_pinocchio(forced, double, dt, tolerance):
    model, states, torque, expected = forced
    after = Flight(model, double=double).run(states, dt, torque=torque)
    found = np.empty_like(expected)
    reference = Reference(model)
    for i in range(len(expected)):
        reference.use_world(i)
        start, turn = Rotation.from_quat(states.quat[i]), Rotation.from_quat(after.quat[i])
        before_twist, after_twist = reference.base_twist(states, i), reference.base_twist(after, i)
        # differences of the origin's velocity, in world axes, and of the angular velocity, in body axes
        found[i, :3] = start.inv().apply(turn.apply(after_twist[:3])) - before_twist[:3]
        found[i, 3:6] = after_twist[3:] - before_twist[3:]
        found[i, 6:] = after.rates[i] - states.rates[i]
    error = np.abs(found / dt - expected).max(axis=1) / np.abs(expected).max(axis=1)  # relative
    assert error.max() < tolerance


def paw_map_kernel(double):
    """Return a kernel of the solver's paw positions and Jacobians (body frame), and the modules of its precision."""
    modules = kernel_modules(double)
    leg = importlib.import_module(f"{modules.step.__package__}.leg_dynamics")
    vec3, mat33, geometry = modules.scalar.vec3, modules.scalar.mat33, modules.geometry.LegGeometry

    @wp.kernel(module="unique", enable_backward=False)
    def kernel(
        legs: wp.array(dtype=geometry),
        angles: wp.array2d(dtype=vec3),
        position: wp.array2d(dtype=vec3),
        jacobian: wp.array2d(dtype=mat33),
    ):
        world, k = wp.tid()
        paw = leg.paw_kinematics(legs[k], leg.leg_pose(legs[k], angles[world, k]))
        position[world, k] = paw.position
        jacobian[world, k] = paw.jacobian

    return kernel, modules


@pytest.mark.parametrize(("double", "tolerance"), [(False, 1e-6), (True, 1e-12)], ids=["f32", "f64"])
def test_paw_position_and_jacobian_match_pinocchio(double, tolerance):
    states = random_states(100, 4)
    kernel, modules = paw_map_kernel(double)
    geometry = leg_geometry_array(load_description(), modules.geometry, "cpu")
    angles = wp.array(states.angles.reshape(-1, 4, 3), dtype=modules.scalar.vec3, device="cpu")
    position = wp.empty(angles.shape, dtype=modules.scalar.vec3, device="cpu")
    jacobian = wp.empty(angles.shape, dtype=modules.scalar.mat33, device="cpu")
    wp.launch(kernel, dim=angles.shape, inputs=[geometry, angles], outputs=[position, jacobian], device="cpu")
    robot = build_pinocchio()
    for i, motors in enumerate(states.angles):
        q = robot.configuration(np.zeros(3), np.array([0.0, 0.0, 0.0, 1.0]), motors)
        assert position.numpy()[i] == pytest.approx(robot.paw_positions(q), abs=tolerance)
        assert jacobian.numpy()[i] == pytest.approx(robot.paw_jacobians(q), abs=tolerance)


@pytest.fixture(scope="module")
def gentle():
    """Six states of slow motion that reaches no stop within a second."""
    states = random_states(6, 5, body_rate=0.5)
    rng = np.random.default_rng(6)
    states.angles = np.tile(np.radians([20.0, 50.0, 50.0]), (6, 4)) + rng.uniform(-0.1, 0.1, (6, 12))
    states.rates = rng.uniform(-0.2, 0.2, (6, 12))
    return states


def inside_stops(states):
    """Return whether all motor angles and outer + inner are at least 0.02 rad inside the stops."""
    total = states.angles[:, 1::3] + states.angles[:, 2::3]
    lower, upper = np.radians([-50.0, -30.0, -30.0] * 4), np.radians([110.0, 140.0, 140.0] * 4)
    margin = 0.02
    return (
        (states.angles > lower + margin).all()
        and (states.angles < upper - margin).all()
        and (total > margin).all()
        and (total < np.radians(240.0) - margin).all()
    )


@pytest.mark.parametrize("gravity", [0.0, -GRAVITY])
def test_energy_and_momentum_drift_in_flight_halves_with_the_step(gentle, gravity):
    model = bare_model(6)
    model.gravity.fill_(wp.vec3(0.0, 0.0, gravity))
    flight, reference = Flight(model, double=True), Reference(model)
    impulse = np.array([0.0, 0.0, gravity * reference.mass])  # [N s] of the weight in 1 s
    energy, linear, angular = [], [], []
    for steps in (1000, 2000, 4000):
        after = flight.run(gentle, 1.0 / steps, steps)
        assert inside_stops(after)
        energy.append([reference.energy(after, i) - reference.energy(gentle, i) for i in range(6)])
        momentum = [reference.momentum(after, i) - reference.momentum(gentle, i) for i in range(6)]
        linear.append([m[:3] - impulse for m in momentum])
        angular.append([m[3:] for m in momentum])
    # Euler's error of free fall is m g^2 dt / 2 = 0.70 J after 1 s; sizes in J, N s, N m s
    for drift, size in ((energy, 0.02 if gravity == 0.0 else 0.72), (linear, 0.01), (angular, 0.005)):
        worst = [np.abs(d).max() for d in drift]
        assert worst[0] < size
        assert np.array(worst[:-1]) / worst[1:] == pytest.approx([2.0, 2.0], rel=0.05)


@pytest.mark.parametrize("loss", ["knees", "motors"])
def test_passive_losses_dissipate_expected_power(loss):
    # knees: 0.1 N m s/rad up to 1 N m; motors: 0.02 N m against the motion
    n, dt = 20, 1e-6
    states, model = random_states(n, 7), bare_model(n)
    lossless = Flight(model, double=True).run(states, dt)
    values = np.zeros((n, DOFS), dtype=np.float32)
    values[:, KNEE_V if loss == "knees" else MOTOR_DOFS] = 0.1 if loss == "knees" else 0.02
    (model.joint_damping if loss == "knees" else model.joint_friction).assign(values.ravel())
    if loss == "knees":
        model.joint_effort_limit.fill_(1.0)
    reference = Reference(model)
    after = Flight(model, double=True).run(states, dt)
    for i in range(n):
        v = reference.state(states, i)[1]
        knees, motors = np.abs(v[reference.robot.knee_v]), np.abs(v[reference.robot.motor_v])
        expected = np.minimum(0.1 * knees, 1.0) @ knees if loss == "knees" else 0.02 * motors.sum()
        found = (reference.energy(lossless, i) - reference.energy(after, i)) / dt
        assert found == pytest.approx(expected, rel=1e-3)


@pytest.mark.parametrize("route", ["body_f", "joint_f"])
def test_wrench_on_the_base_changes_the_momentum_of_the_robot(route):
    # oracle: Newton-Euler, with the force at the base link's com
    n, dt = 20, 1e-6
    model, states = loaded_model(n, 8), random_states(n, 9)
    force, moment = np.array([30.0, -20.0, 50.0]), np.array([0.0, 0.0, 7.0])  # [N], [N m]
    wrench = np.concatenate([force, moment])
    arguments = {"body_f": wrench} if route == "body_f" else {"base_joint_f": wrench}
    after = Flight(model, double=True).run(states, dt, **arguments)
    reference = Reference(model)
    for i in range(n):
        reference.use_world(i)
        rate = (reference.momentum(after, i) - reference.momentum(states, i)) / dt
        arm = states.pos[i] + Rotation.from_quat(states.quat[i]).apply(reference.base_com)
        arm -= reference.centre_of_mass(states, i)
        assert rate[:3] == pytest.approx(force - [0.0, 0.0, GRAVITY * reference.mass], abs=1e-3)
        assert rate[3:] == pytest.approx(moment + np.cross(arm, force), abs=1e-3)
