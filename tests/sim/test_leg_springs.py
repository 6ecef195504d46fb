"""Springs between the knees: torques against energy, conservation of energy, and agreement of both solvers."""

import numpy as np
import pinocchio as pin
import pytest

from jumper_warp.robot.model import load_description
from jumper_warp.robot.overlay import RobotOverlay, with_springs
from jumper_warp.robot.pinocchio_model import build_pinocchio
from jumper_warp.sim.simulation import Simulation, motor_values
from jumper_warp.utils.errors import InputError
from solver_helpers import Flight, Reference, bare_model, random_states

STIFFNESS, LENGTH = 1000.0, 0.17
NAMES = [[f"{leg}_{bar}_knee" for bar in ("outer", "inner")] for leg in ("FL", "FR", "BL", "BR")]


def knee_distances(angles: np.ndarray) -> np.ndarray:
    """Return the distances [m] of the knees (n, 4) for motor angles (n, 12), by Pinocchio's forward kinematics."""
    robot, found = build_pinocchio(load_description()), []
    for row in angles:
        pin.forwardKinematics(robot.model, robot.data, robot.configuration(np.zeros(3), [0.0, 0.0, 0.0, 1.0], row))
        places = [[robot.data.oMi[robot.model.getJointId(name)].translation for name in pair] for pair in NAMES]
        found.append([np.linalg.norm(outer - inner) for outer, inner in places])
    return np.array(found)


def spring_energy(angles: np.ndarray) -> np.ndarray:
    """Return the energy [J] of all springs of each robot; angles (n, 12)."""
    return 0.5 * STIFFNESS * ((knee_distances(angles) - LENGTH) ** 2).sum(axis=1)


def flight(n: int, springs: bool = True, double: bool = True) -> Flight:
    """Return robots that float in zero gravity, with springs or without."""
    model = bare_model(n)
    model.gravity.zero_()
    found = Flight(model, double=double)
    if springs:
        found.dynamics.leg_springs.assign(np.tile([STIFFNESS, LENGTH], (n, 1)).astype(np.float32))
        found.dynamics.pack_springs()
    return found


def test_spring_torques_are_the_gradient_of_energy():
    # the change of generalized momentum over a short step, with springs less without, is their torque: power matches
    n, dt, h = 40, 1.0e-6, 1.0e-5
    states = random_states(n, 3)
    rates = states.rates
    steps = np.array([-1.0, 1.0])
    ends = np.array([spring_energy(states.angles + sign * h * rates) for sign in steps])
    power = (ends[0] - ends[1]) / (2.0 * h)  # that the springs put in
    reference = Reference(bare_model(n))
    after = [flight(n, springs).run(states, dt) for springs in (True, False)]
    gained = [np.array([kinetic(reference, each, i) for i in range(n)]) for each in after]
    found = (gained[0] - gained[1]) / dt
    assert np.abs(power).max() > 100.0
    np.testing.assert_allclose(found, power, atol=2e-3 * np.abs(power).max())


def kinetic(reference: Reference, states, i: int) -> float:
    """Return the kinetic energy [J]; Pinocchio's potential energy taken away."""
    q, _ = reference.state(states, i)
    robot = reference.robot
    return reference.energy(states, i) - pin.computePotentialEnergy(robot.model, robot.data, q)


def test_springs_conserve_energy():
    # from a little longer than at rest, inside the stops; what a step loses falls with its length
    n, seconds, parts = 2, 0.4, 8
    states = random_states(n, 5, body_rate=0.0, joint_rate=0.0)
    states.angles[:] = np.tile(np.radians([5.0, 19.0, 22.0]), (n, 4)) + 0.02 * np.arange(n)[:, None]
    states.com_vel[:] = 0.0
    reference, stored = Reference(bare_model(n)), spring_energy(states.angles)
    lost, most = [], 0.0
    for refine in (1, 2):
        steps, now, energy = round(480 * seconds) * refine, states, []
        for _ in range(parts):
            now = flight(n).run(now, seconds / steps, steps // parts)
            moving = np.array([kinetic(reference, now, i) for i in range(n)])
            most = max(most, moving.max())
            energy.append(moving + spring_energy(now.angles))
        lost.append(np.abs(np.array(energy) - stored).max() / stored.max())
    assert stored.min() > 2.0 and most > 0.8 * stored.max()
    assert lost[0] < 0.15 and abs(2.0 * lost[1] - lost[0]) < 0.02  # of a step of no length


@pytest.mark.parametrize("stiffness", [0.0, STIFFNESS])
def test_springs_move_alike_on_both_solvers(stiffness):
    # a robot that hangs in the air with weak motors: the springs stretch its legs
    angles = {}
    for solver in ("jumper", "mujoco"):
        sim = Simulation(1, solver=solver, ground=None, gravity=0.0, dt=1.0 / 1920.0, visuals=False, device="cpu",
                         robot=with_springs(stiffness, LENGTH))  # fmt: skip
        sim.motors.kp.fill_(0.0)
        for _ in range(12):
            sim.step()
        angles[solver] = motor_values(sim.joint_q()[:, 7:])[0]
    moved = np.abs(angles["jumper"] - np.tile(np.radians([0.0, 45.0, 45.0]), 4)).max()
    assert moved > 0.3 if stiffness else moved < 0.01
    np.testing.assert_allclose(angles["mujoco"], angles["jumper"], atol=0.02)


def test_refuses_bad_springs():
    with pytest.raises(InputError, match="spring_stiffness must be in 0 to 10000 N/m"):
        with_springs(-1.0, 0.17)
    with pytest.raises(InputError, match="spring_length must be in 0 to 1 m"):
        with_springs(1000.0, 17.0)
    assert RobotOverlay.from_json(with_springs(1000.0, 0.17).to_json()).values["spring_length"] == (0.17,)
