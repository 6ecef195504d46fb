"""The robot in Pinocchio: geometry by hand, and velocities and dynamics by finite differences and conservation laws."""

import numpy as np
import pinocchio as pin
import pytest

from jumper_warp.robot.description import load_description
from pinocchio_model import build_pinocchio

LEVEL = (0.0, 0.0, 0.0, 1.0)  # xyzw


@pytest.fixture(scope="module")
def robot():
    """Return Pinocchio's model of the robot."""
    return build_pinocchio(load_description())


@pytest.fixture
def moving(robot):
    """A random configuration (27,) and velocity (26,) with closed loops."""
    rng = np.random.default_rng(3)
    motors = np.tile(np.radians([0.0, 60.0, 60.0]), 4) + rng.uniform(-0.5, 0.5, 12)
    quat = rng.normal(size=4)
    q = robot.configuration(rng.normal(size=3), quat / np.linalg.norm(quat), motors)
    return q, robot.closed_velocity(q, rng.normal(size=6), 4.0 * rng.normal(size=12))


def test_configuration_closes_the_loops(moving, robot):
    assert robot.loop_gap(moving[0]) < 1e-12


def test_closed_velocity_matches_differences_of_configurations(moving, robot):
    q, v = moving
    step = 1e-6  # [s]
    ahead, behind = (
        robot.configuration(q[0:3], q[3:7], q[robot.motor_q] + sign * step * v[robot.motor_v]) for sign in (1, -1)
    )
    rates = (ahead - behind)[robot.knee_q] / (2.0 * step)
    assert v[robot.knee_v] == pytest.approx(rates, abs=1e-7)


def test_paw_velocities_and_jacobians_match_differences_of_positions(moving, robot):
    q, v = moving
    step = 1e-6  # [s]
    ahead, behind = (robot.paw_positions(pin.integrate(robot.model, q, sign * step * v)) for sign in (1, -1))
    assert robot.paw_velocities(q, v) == pytest.approx((ahead - behind) / (2.0 * step), abs=1e-7)
    fixed_base = robot.closed_velocity(q, np.zeros(6), v[robot.motor_v])
    velocities = np.einsum("kij,kj->ki", robot.paw_jacobians(q), v[robot.motor_v].reshape(4, 3))
    assert velocities == pytest.approx(robot.paw_velocities(q, fixed_base), abs=1e-12)


def test_robot_at_rest_falls_freely(robot):
    q = robot.configuration((0.0, 0.0, 1.0), LEVEL, np.tile(np.radians([10.0, 60.0, 40.0]), 4))
    acceleration = robot.forward_dynamics(q, np.zeros(26), np.zeros(12))
    assert acceleration[:6] == pytest.approx([0.0, 0.0, -9.81, 0.0, 0.0, 0.0], abs=1e-8)
    assert acceleration[6:] == pytest.approx(np.zeros(20), abs=1e-7)


def test_energy_changes_by_motor_power(moving, robot):
    q, v = moving
    torques = np.linspace(-10.0, 10.0, 12)
    acceleration = robot.forward_dynamics(q, v, torques)

    def energy(time):
        """Return the energy [J] after a time [s] at constant acceleration."""
        rates = v + time * acceleration
        pose = pin.integrate(robot.model, q, time * v + 0.5 * time**2 * acceleration)
        upper = np.triu(pin.crba(robot.model, robot.data, pose))  # mass matrix with the rotors
        kinetic = rates @ upper @ rates - 0.5 * np.diag(upper) @ rates**2
        return kinetic + pin.computePotentialEnergy(robot.model, robot.data, pose)

    step = 1e-5  # [s]
    power = torques @ v[robot.motor_v]  # [W]
    assert (energy(step) - energy(-step)) / (2.0 * step) == pytest.approx(power, rel=1e-5)
