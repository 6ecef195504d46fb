"""The robot in Pinocchio: geometry by hand, and velocities and dynamics by finite differences and conservation laws."""

import math

import numpy as np
import pinocchio as pin
import pytest

from jumper_warp.robot.description import MOTOR_JOINTS, load_description
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


def test_mass_motor_indices_and_armature(robot):
    assert pin.computeTotalMass(robot.model) == pytest.approx(14.5)
    names = [robot.model.names[joint] for joint in range(robot.model.njoints)]
    by_velocity = {robot.model.joints[joint].idx_v: names[joint] for joint in range(1, robot.model.njoints)}
    assert [by_velocity[index] for index in robot.motor_v] == list(MOTOR_JOINTS)
    assert robot.model.armature[robot.motor_v[:3]] == pytest.approx([4.69e-3, 4.14e-3, 4.14e-3], rel=1e-3)
    assert not robot.model.armature[robot.knee_v].any()


@pytest.mark.parametrize(("degrees", "depth"), [(0, 0.4716), (45, 0.3718)])  # both thighs; [m]
def test_ankle_depth_below_the_hips(robot, degrees, depth):
    q = robot.configuration((0.0, 0.0, 0.0), LEVEL, np.tile(np.radians([0.0, degrees, degrees]), 4))
    assert -robot.paw_positions(q)[:, 2] == pytest.approx(np.full(4, depth), abs=5e-5)


def test_lateral_motor_swings_the_paw_outward(robot):
    # at 90 degrees the ankle is 0.3718 m outward of the hip and 0.0602 m above it; the right hip is at y = -0.105 m
    q = robot.configuration((0.0, 0.0, 0.0), LEVEL, np.tile(np.radians([90.0, 45.0, 45.0]), 4))
    assert robot.paw_positions(q)[1, 1:] == pytest.approx([-0.105 - 0.3718, 0.0602], abs=5e-5)


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


def test_loops_stay_closed_while_moving(moving, robot):
    q, v = moving
    acceleration = robot.forward_dynamics(q, v, np.linspace(-10.0, 10.0, 12))
    # gaps grow with time^3, or with time or time^2 if velocity or acceleration did not keep the loops closed
    gaps = [
        robot.loop_gap(pin.integrate(robot.model, q, time * v + 0.5 * time**2 * acceleration)) for time in (1e-3, 2e-3)
    ]
    assert math.log2(gaps[1] / gaps[0]) == pytest.approx(3.0, abs=0.3)
