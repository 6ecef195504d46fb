"""Platforms and uneven ground: heights, slopes and correlation, and robots that land and stand on them."""

import numpy as np
import pytest

from columns import X, Z
from ground_helpers import heights, probe
from jumper_warp.robot import grounds
from simulation_helpers import PAW_RADIUS, WEIGHT, paw_centres, paw_forces, simulation, thrown, write_state


@pytest.mark.parametrize("height", [-0.15, 0.15])
def test_platform_steps_within_one_cell_behind_its_edge(height):
    field = grounds.platform(height, edge=0.5)
    x, y = [-3.0, 0.0, 0.499, 0.51, 0.521, 3.0], [0.0, 0.7, -1.9, 1.0, -0.3, 0.2]  # [m] the cell is from 0.50 to 0.52
    z, slope_x, slope_y = probe(field, x, y).T
    assert z == pytest.approx([0.0, 0.0, 0.0, 0.5 * height, height, height], abs=1e-5)
    assert slope_x == pytest.approx([0.0, 0.0, 0.0, height / 0.02, 0.0, 0.0], abs=1e-3)
    assert slope_y == pytest.approx(np.zeros(6), abs=1e-5)


@pytest.mark.parametrize("seed", range(4))
def test_uneven_ground_has_bounded_slopes_and_a_level_start(seed):
    field = grounds.uneven(0.05, seed, flat_radius=0.6)
    z = heights(field)
    x = np.linspace(-2.0, 2.0, z.shape[0])
    assert np.abs(z).max() == pytest.approx(0.05, abs=1e-6)
    assert np.abs(z[np.hypot(x[:, None], x) <= 0.6]).max() < 1e-6
    slope = np.degrees(np.arctan(np.hypot(*np.gradient(z, x[1] - x[0]))))
    assert 18.0 < slope.max() < 28.0  # [deg]


def test_uneven_ground_has_its_correlation_length():
    correlations = []  # at 0.2 m, along both axes
    for seed in range(8):
        z = heights(grounds.uneven(seed=seed, length=0.2, flat_radius=0.0, cell=0.025))
        z = z / z.std()
        correlations += [(z[:, 8:] * z[:, :-8]).mean(), (z[8:] * z[:-8]).mean()]  # 8 cells are 0.2 m
    assert np.mean(correlations) == pytest.approx(np.exp(-1.0), abs=0.08)


def test_uneven_ground_is_reproducible_by_seed():
    first = heights(grounds.uneven(seed=3))
    assert np.array_equal(first, heights(grounds.uneven(seed=3)))
    assert np.abs(first - heights(grounds.uneven(seed=4))).max() > 0.02


def dropped(field, offset, lift, num_worlds=1):
    """Return a simulation of robots in the standing pose at x = offset [m], paws at z = lift [m], before they fall."""
    sim = simulation(num_worlds, ground=field)
    q = sim.joint_q().copy()
    q[:, X] += offset
    q[:, Z] += lift
    write_state(sim, q)
    return sim


@pytest.mark.parametrize("height", [-0.15, 0.15])
def test_robot_lands_on_a_platform(height):
    sim = dropped(grounds.platform(height, edge=0.5), offset=1.2, lift=height + 0.3)
    for _ in range(150):  # 2.5 s
        sim.step()
    assert paw_centres(sim)[0, :, 2] == pytest.approx(np.full(4, height + PAW_RADIUS), abs=1e-3)
    assert paw_forces(sim)[0].sum(axis=0) == pytest.approx([0.0, 0.0, WEIGHT], abs=0.01 * WEIGHT)


def test_robot_stands_on_uneven_ground():
    field = grounds.uneven()
    sim = dropped(field, offset=1.2, lift=0.15)
    for _ in range(180):  # 3 s
        sim.step()
    before = paw_centres(sim)
    for _ in range(60):  # 1 s
        sim.step()
    paws = paw_centres(sim)
    assert np.abs(paws - before).max() < 1e-3  # [m]
    z, slope_x, slope_y = probe(field, paws[0, :, 0], paws[0, :, 1]).T
    # a sphere on a slope: its centre is radius / cos(slope) above the surface, up to the curvature
    assert paws[0, :, 2] - z == pytest.approx(PAW_RADIUS * np.sqrt(1.0 + slope_x**2 + slope_y**2), abs=2e-3)
    assert paw_forces(sim)[0].sum(axis=0) == pytest.approx([0.0, 0.0, WEIGHT], abs=0.01 * WEIGHT)


def test_robots_thrown_across_an_edge_stay_slow_finite_and_above_ground():
    sim = simulation(32, ground=grounds.platform(-0.15, edge=0.3))
    thrown(sim, seed=5, height=(0.4, 0.7))
    for _ in range(90):
        sim.step()
        assert np.abs(sim.base_velocity()).max() < 8.0  # [m/s]
    assert not sim.solver.diverged.numpy().any()
    paws = paw_centres(sim)
    before_edge = paws[..., X] < 0.3 - PAW_RADIUS
    assert paws[before_edge][:, 2].min() > PAW_RADIUS - 5e-3  # 5 mm of penetration
    assert paws[..., Z].min() > -0.15 + PAW_RADIUS - 5e-3
