"""Springs between the knees: torques against energy, conservation of energy, and agreement of both solvers."""

import numpy as np
import pinocchio as pin
import pytest

from jumper_warp.robot.model import load_description
from jumper_warp.robot.overlay import RobotOverlay
from jumper_warp.sim.simulation import Simulation, motor_values
from pinocchio_model import build_pinocchio
from solver_helpers import Flight, Reference, bare_model, random_states

STIFFNESS, LENGTH = 1000.0, 0.17  # [N/m], [m]
KNEES = [[f"{leg}_{bar}_knee" for bar in ("outer", "inner")] for leg in ("FL", "FR", "BL", "BR")]


def knee_distances(angles: np.ndarray) -> np.ndarray:
    """Return the knee distances [m], (n, 4), for motor angles [rad], (n, 12), by Pinocchio's forward kinematics."""
    robot, distances = build_pinocchio(load_description()), []
    for row in angles:
        pin.forwardKinematics(robot.model, robot.data, robot.configuration(np.zeros(3), [0.0, 0.0, 0.0, 1.0], row))
        places = [[robot.data.oMi[robot.model.getJointId(name)].translation for name in pair] for pair in KNEES]
        distances.append([np.linalg.norm(outer - inner) for outer, inner in places])
    return np.array(distances)


def spring_energy(angles: np.ndarray) -> np.ndarray:
    """Return the energy [J] of the four springs of each robot, (n,), for motor angles [rad], (n, 12)."""
    return 0.5 * STIFFNESS * ((knee_distances(angles) - LENGTH) ** 2).sum(axis=1)


def flight(n: int, springs: bool = True, double: bool = True) -> Flight:
    """Return a `Flight` of n robots in zero gravity, with or without springs."""
    model = bare_model(n)
    model.gravity.zero_()
    flight = Flight(model, double=double)
    if springs:
        flight.dynamics.leg_springs.assign(np.tile([STIFFNESS, LENGTH], (n, 1)).astype(np.float32))
        flight.dynamics.pack()
    return flight


def test_spring_torques_are_the_gradient_of_energy():
    # the springs' power from differences of their energy equals the rate of kinetic energy with minus without springs
    n, dt, h = 40, 1.0e-6, 1.0e-5  # robots, [s], [s]
    states = random_states(n, 3)
    rates = states.rates
    steps = np.array([-1.0, 1.0])
    ends = np.array([spring_energy(states.angles + sign * h * rates) for sign in steps])
    power = (ends[0] - ends[1]) / (2.0 * h)  # [W] of the springs on the robot
    reference = Reference(bare_model(n))
    after = [flight(n, springs).run(states, dt) for springs in (True, False)]
    energies = [np.array([kinetic(reference, states, i) for i in range(n)]) for states in after]
    found = (energies[0] - energies[1]) / dt
    assert np.abs(power).max() > 100.0
    np.testing.assert_allclose(found, power, atol=2e-3 * np.abs(power).max())


def kinetic(reference: Reference, states, i: int) -> float:
    """Return the kinetic energy [J] of robot i: its total energy minus Pinocchio's potential energy."""
    q, _ = reference.state(states, i)
    robot = reference.robot
    return reference.energy(states, i) - pin.computePotentialEnergy(robot.model, robot.data, q)


def test_springs_conserve_energy_up_to_the_error_of_the_step():
    # starts at rest with stretched springs, inside the stops; the error is proportional to the step
    n, seconds, parts = 2, 0.4, 8
    states = random_states(n, 5, body_rate=0.0, joint_rate=0.0)
    states.angles[:] = np.tile(np.radians([5.0, 19.0, 22.0]), (n, 4)) + 0.02 * np.arange(n)[:, None]
    states.com_vel[:] = 0.0
    reference, stored = Reference(bare_model(n)), spring_energy(states.angles)
    errors, largest_kinetic = [], 0.0  # [1] of the stored energy, [J]
    for refine in (1, 2):
        steps, now, energy = round(480 * seconds) * refine, states, []
        for _ in range(parts):
            now = flight(n).run(now, seconds / steps, steps // parts)
            moving = np.array([kinetic(reference, now, i) for i in range(n)])
            largest_kinetic = max(largest_kinetic, moving.max())
            energy.append(moving + spring_energy(now.angles))
        errors.append(np.abs(np.array(energy) - stored).max() / stored.max())
    assert stored.min() > 2.0 and largest_kinetic > 0.8 * stored.max()
    assert errors[0] < 0.15 and abs(2.0 * errors[1] - errors[0]) < 0.02  # extrapolated to a step of 0 s


@pytest.mark.parametrize("stiffness", [0.0, STIFFNESS])
def test_springs_move_alike_on_both_solvers(stiffness):
    # in zero gravity with motors of kp 0, the springs move the legs
    angles = {}
    for solver in ("jumper", "mujoco"):
        robot = RobotOverlay({"spring_stiffness": (stiffness,), "spring_length": (LENGTH,)})
        sim = Simulation(1, solver=solver, ground=None, gravity=0.0, dt=1.0 / 1920.0, visuals=False, device="cpu",
                         robot=robot)  # fmt: skip
        sim.motors.kp.fill_(0.0)
        for _ in range(12):
            sim.step()
        angles[solver] = motor_values(sim.joint_q()[:, 7:])[0]
    moved = np.abs(angles["jumper"] - np.tile(np.radians([0.0, 45.0, 45.0]), 4)).max()
    assert moved > 0.3 if stiffness else moved < 0.01  # [rad]
    np.testing.assert_allclose(angles["mujoco"], angles["jumper"], atol=0.02)
