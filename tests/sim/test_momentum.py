"""Momentum projection (`keep_momentum`): exact in free flight, inactive under a contact or a wrench on the base."""

import numpy as np
import pytest

from columns import ANG_VEL, XY, Z
from jumper_warp.robot.gravity import MARS
from jumper_warp.robot.motors import jumping_motors
from jumper_warp.sim.simulation import Simulation
from momentum_oracle import momentum

N = 2  # worlds
STEPS = 45  # policy steps, 0.75 s


def moving_legs(keep: bool, *, height: float, push: float = 0.0, reach: float = 0.4) -> tuple[Simulation, list]:
    """Return a simulation after leg motion of `reach` [rad] at `height` [m], and its momenta after every step."""
    sim = Simulation(N, motors=jumping_motors(), gravity=MARS, keep_momentum=keep, visuals=False, device="cpu")
    q, qd = sim.joint_q().copy(), sim.joint_qd().copy()
    q[:, Z] += height
    if height:
        qd[:, ANG_VEL] = [0.5, -0.3, 0.2]
    sim.state.joint_q.assign(q.ravel())
    sim.state.joint_qd.assign(qd.ravel())
    wrench = np.zeros((N, 21, 6), dtype=np.float32)
    wrench[:, 0, 3] = push  # [N m] about x
    sim.state.body_f.assign(wrench.reshape(-1, 6))
    momenta = [momentum(sim)]  # (linear, angular), (N, 3) each
    for i in range(STEPS):
        swing = reach * np.sin(0.3 * i + np.arange(12))
        sim.target.assign(np.tile((np.tile([0.0, 0.8, 0.8], 4) + swing)[:, None], (1, N)).astype(np.float32))
        sim.step()
        momenta.append(momentum(sim))
    return sim, momenta


@pytest.fixture(scope="module")
def flights():
    """Return (simulation, momenta) of a free flight, by value of `keep_momentum`."""
    return {keep: moving_legs(keep, height=5.0) for keep in (False, True)}


def test_momentum_changes_by_gravity_alone_in_flight(flights):
    sim, projected = flights[True]
    mass = sim.model.body_mass.numpy()[:21].sum()
    time = np.arange(STEPS + 1) / 60.0
    linear, angular = (np.array([pair[i] for pair in projected]) for i in (0, 1))  # (STEPS + 1, N, 3)
    np.testing.assert_allclose(linear[:, :, Z] - linear[0, :, 2], np.outer(-mass * MARS * time, np.ones(N)), atol=1e-3)
    np.testing.assert_allclose(linear[:, :, XY], np.tile(linear[0, :, :2], (STEPS + 1, 1, 1)), atol=1e-4)
    np.testing.assert_allclose(angular, np.tile(angular[0], (STEPS + 1, 1, 1)), atol=2e-5)
    drift = np.abs(np.array([pair[1] for pair in flights[False][1]]) - angular[0]).max()
    assert np.abs(angular).max() > 0.2 and drift > 1e-3  # [kg m^2/s]; drift without projection


def test_bodies_match_projected_coordinates(flights):
    sim = flights[True][0]
    written = sim.state.body_qd.numpy().copy()
    sim.write_bodies()
    np.testing.assert_array_equal(sim.state.body_qd.numpy(), written)


@pytest.mark.parametrize(
    "case", [{"height": 0.0, "reach": 0.03}, {"height": 5.0, "push": 0.5}], ids=["contact", "push"]
)
def test_momentum_is_not_projected_under_contact_or_push(case):
    rates = [moving_legs(keep, **case)[0].joint_qd() for keep in (False, True)]
    assert np.abs(rates[0][:, 6:]).max() > 0.1  # [rad/s]
    np.testing.assert_array_equal(*rates)
