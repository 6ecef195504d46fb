"""Energy of robots without motor torque that fall, collapse and come to rest."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from columns import Z
from jumper_warp.robot.model import LIMIT_STIFFNESS, build_model
from simulation_helpers import PAW_RADIUS, paw_centres, simulation, write_state
from solver_helpers import Flight, Reference, random_states
from test_stops import BOUNDED, DT, LOWER, UPPER


def energy(reference, states):
    """Return kinetic and potential energy of robots and of the springs of their stops [J], (n,)."""
    bounded = states.angles @ BOUNDED.T
    inside = np.maximum(np.maximum(LOWER - bounded, bounded - UPPER), 0.0)
    robots = [reference.energy(states, i) for i in range(len(states.pos))]
    return np.array(robots) + 0.5 * LIMIT_STIFFNESS * (inside**2).sum(axis=1)


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
    start = before = energy(reference, states)
    gained, fastest = -np.inf, 0.0
    for _ in range(120):
        states = robots.run(states, DT)
        after = energy(reference, states)
        gained = max(gained, (after - before).max())
        fastest = max(fastest, np.abs(states.rates).max())
        before = after
    assert gained < rounding  # [J]
    assert np.median(start - before) > 10.0
    assert 30.0 < fastest < 50.0  # [rad/s]
