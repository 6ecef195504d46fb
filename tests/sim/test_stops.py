"""Hard stops: robots that rest on them, step velocities against a quadratic program, and dissipated energy."""

import math

import numpy as np
import pytest
import warp as wp
from scipy.optimize import nnls
from scipy.spatial.transform import Rotation

from columns import DOFS, MOTOR_DOFS, Z
from jumper_warp.kernels import layout
from jumper_warp.robot.model import LIMIT_DAMPING, LIMIT_STIFFNESS, build_model
from jumper_warp.robot.motors import vertical_jump_filter
from jumper_warp.sim.dynamics import JumperDynamics
from simulation_helpers import (
    PAW_RADIUS,
    WEIGHT,
    command,
    paw_centres,
    paw_forces,
    simulation,
    slope,
    tilted,
    write_state,
)
from solver_helpers import BODIES, Flight, Reference, States, random_states

DT = 1.0 / 480.0
BOUNDED = np.vstack([np.eye(12), np.kron(np.eye(4), [0.0, 1.0, 1.0])])
"""(16, 12) matrix from motor angles to the quantities with stops: 12 motors, and outer + inner of 4 legs."""
LOWER = np.radians([-50.0, -30.0, -30.0] * 4 + [0.0] * 4).astype(np.float32).astype(float)
UPPER = np.radians([110.0, 140.0, 140.0] * 4 + [240.0] * 4).astype(np.float32).astype(float)
STRENGTH = DT * LIMIT_STIFFNESS + LIMIT_DAMPING  # [N m s/rad] torque of an implicit stop per speed
SQUATS = [2.05, 2.1, 2.4, 2.6]
"""[rad] Targets of the transversal motors; their stop is at 2.09 rad."""


def ripple(sim, transversal, ramp=25, settle=60, steps=240):
    """Return the ripple of paw forces of robots that stand with transversal targets [rad], (num_worlds,).

    Targets are reached after `ramp` policy steps; `settle` more precede `steps` physics steps of measurement. Ripple:
    peak to peak of each paw [N], (num_worlds, 4), and fraction of paw-steps without contact.
    """
    start = sim.target.numpy().T.copy()
    goal = np.outer(transversal, [0.0, 1.0, 1.0] * 4)
    for tick in range(ramp + settle):
        command(sim, start + min(1.0, (tick + 1) / ramp) * (goal - start))
        sim.step()
    forces = []
    for tick in range(steps):
        if tick % sim.substeps == 0:
            sim.filter_targets()
        sim.physics_step()
        forces.append(np.linalg.norm(paw_forces(sim), axis=2))
    forces = np.array(forces)
    assert forces.sum(axis=2).min() > 0.9 * WEIGHT  # they stand
    return np.ptp(forces, axis=0), (forces <= 0.0).mean()


@pytest.mark.parametrize("case", ["plane", "filtered", "slope"])
def test_robot_rests_on_the_stops(case):
    targets = np.array([*SQUATS, -0.4, -0.7] if case != "slope" else SQUATS)
    arguments = {"filtered": {"command_filter": vertical_jump_filter()}, "slope": {"ground": slope(10.0)}}
    sim = simulation(len(targets), **arguments.get(case, {}))
    if case == "slope":
        tilted(sim, 10.0)
    peak_to_peak, lost = ripple(sim, targets)
    assert peak_to_peak.max() < 0.01 * WEIGHT
    assert lost == 0.0


def at_the_stops(n, seed, joint_rate=8.0):
    """Return n random states with half of the bounded quantities within 1 degree of a stop, on either side of it."""
    rng, states = np.random.default_rng(seed), random_states(n, seed, joint_rate=joint_rate)
    for angles in states.angles:
        for i in rng.permutation(16)[:8]:
            bound = (LOWER, UPPER)[rng.integers(2)][i] + math.radians(rng.uniform(-1.0, 1.0))
            row = BOUNDED[i]
            angles += row * (bound - row @ angles) / (row @ row)
    return states


class StopSteps:
    """Single steps in double precision, with or without stops."""

    def __init__(self, num_worlds, *, stops):
        """stops: whether the stops have stiffness and damping."""
        self.n, self.model = num_worlds, build_model(num_worlds, visuals=False, device="cpu")
        self.dynamics = JumperDynamics(self.model, max_sweeps=5000, tolerance=1.0e-9, double=True)
        if not stops:
            table = self.dynamics.robot.table.numpy()
            for leg in range(4):
                row = leg * int(layout.LEG_ROWS)
                table[row + int(layout.STOP_KE)] = table[row + int(layout.STOP_KD)] = 0.0
            self.dynamics.robot.table.assign(table)

    def bounds(self):
        """Return the lower and upper stops of the bounded quantities [rad], (16,) each, from the table."""
        table = self.dynamics.robot.table.numpy()[:, 0]
        legs = np.arange(4)[:, None] * int(layout.LEG_ROWS)
        single = (table[legs + int(row) + np.arange(3)].ravel() for row in (layout.LOWER, layout.UPPER))
        sums = (table[legs[:, 0] + int(row)] for row in (layout.SUM_LOWER, layout.SUM_UPPER))
        return [np.append(*pair) for pair in zip(single, sums, strict=True)]

    def run(self, states, torque=0.0):
        """Return states with the velocities after a step and the poses before it; torque: [N m], scalar or (n, 12)."""
        joint_f = np.zeros((self.n, DOFS))
        joint_f[:, MOTOR_DOFS] = torque
        q, qd, force = (wp.array(v, dtype=wp.float64) for v in (states.joint_q(), states.joint_qd(), joint_f.ravel()))
        self.dynamics.work.impulse.zero_()
        drive = self.dynamics.drive(force, wp.zeros(self.n * BODIES, dtype=wp.spatial_vector))
        self.dynamics.advance(DT, 1, drive, q, qd, q, qd)
        new = States.read(q.numpy(), qd.numpy())
        com = self.model.body_com.numpy()[::BODIES].astype(float)
        before, after = Rotation.from_quat(states.quat), Rotation.from_quat(new.quat)
        origin = new.com_vel - np.cross(new.ang_vel, after.apply(com))
        ang = before.apply(after.inv().apply(new.ang_vel))
        return States(
            states.pos.copy(), states.quat, origin + np.cross(ang, before.apply(com)), ang, states.angles, new.rates
        )


def repeated(states, times):
    """Return states in which each state is repeated `times` times."""
    return States(*(np.repeat(values, times, axis=0) for values in vars(states).values()))


def test_stops_solve_a_quadratic_program():
    """In flight the rates are affine in the torques, so that stops without contact are a least-squares problem.

    With torques f >= 0 of both stops of each quantity, speeds s = s_free + J A J' f away from them and the law
    0 <= f, s + f / c >= goal, complementary: minimise f' (J A J' + 1 / c) f / 2 + f' (s_free - goal).
    """
    n = 40
    states = at_the_stops(n, 21)
    states.pos[:, Z] = 3.0
    stopping = StopSteps(n, stops=True)
    found, (lower, upper) = stopping.run(states).rates, stopping.bounds()
    units = np.tile(np.vstack([np.zeros(12), np.eye(12)]), (n, 1))
    free = StopSteps(13 * n, stops=False).run(repeated(states, 13), units).rates.reshape(n, 13, 12)
    toward = np.vstack([BOUNDED, -BOUNDED])
    several = changed = 0  # states with more than two pressed stops, or other ones than the initial rates press
    for i in range(n):
        response = (free[i, 1:] - free[i, 0]).T
        gaps = toward @ states.angles[i] - np.append(lower, -upper)
        goal = np.where(gaps > 0.0, -gaps / DT, -gaps * LIMIT_STIFFNESS / STRENGTH)
        matrix = toward @ response @ toward.T
        factor = np.linalg.cholesky(0.5 * (matrix + matrix.T) + np.eye(32) / STRENGTH)
        torque, _ = nnls(factor.T, np.linalg.solve(factor, goal - toward @ free[i, 0]))
        np.testing.assert_allclose(found[i], free[i, 0] + response @ toward.T @ torque, rtol=0.0, atol=1.0e-6)
        pressed = torque > 0.0
        several += pressed.reshape(2, 16)[:, :12].sum() > 2
        changed += (pressed != (toward @ states.rates[i] < goal)).any()
    assert several > n // 2
    assert changed > 5


def spring_energy(angles):
    """Return the energy [J] of the springs of all stops, (n,); angles [rad]: (n, 12)."""
    bounded = angles @ BOUNDED.T
    inside = np.maximum(np.maximum(LOWER - bounded, bounded - UPPER), 0.0)
    return 0.5 * LIMIT_STIFFNESS * (inside**2).sum(axis=1)


@pytest.mark.parametrize(("double", "rounding"), [(False, 1.0e-4), (True, 1.0e-9)])
def test_robots_without_motors_gain_no_energy_in_any_step(double, rounding):
    """Legs reach 38 rad/s; beyond 50 rad/s they turn so far in a step that its discretisation may gain energy."""
    n = 40
    states = random_states(n, 3, joint_rate=4.0)
    tilts = np.random.default_rng(1).normal(size=(n, 3)) * [0.3, 0.3, 1.0]  # [rad]
    states.quat[:] = Rotation.from_euler("xyz", tilts).as_quat()
    sim = simulation(n)
    write_state(sim, states.joint_q().reshape(n, -1))
    states.pos[:, Z] += PAW_RADIUS + 1.0e-4 - paw_centres(sim)[..., Z].min(axis=1)  # a paw in the ground is pushed out
    model = build_model(n, visuals=False, device="cpu")
    robots, reference = Flight(model, double=double), Reference(model)

    def energy(states):
        """Return kinetic and potential energy of robots and of the springs of their stops [J], (n,)."""
        return np.array([reference.energy(states, i) for i in range(n)]) + spring_energy(states.angles)

    start = before = energy(states)
    gained, fastest = -np.inf, 0.0
    for _ in range(120):
        states = robots.run(states, DT)
        after = energy(states)
        gained = max(gained, (after - before).max())
        fastest = max(fastest, np.abs(states.rates).max())
        before = after
    assert gained < rounding  # [J]
    assert np.median(start - before) > 10.0
    assert 30.0 < fastest < 50.0  # [rad/s]
