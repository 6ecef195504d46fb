"""Terrain map: heights of each kind of tile, and their placement, against NumPy and the kernels' surface."""

from dataclasses import replace

import numpy as np
import pytest

from ground_helpers import heights, probe
from jumper_warp.robot.terrain import KINDS, TerrainCfg, terrain_map, tile_heights

CFG = TerrainCfg(rows=2, tile=4.0, cell=0.1, start=0.5, border=1.0)
NODES = 41  # along an edge of 4 m
AXIS = np.linspace(-2.0, 2.0, NODES)  # [m] from the middle
OFF = np.maximum(np.abs(AXIS[:, None]), np.abs(AXIS))  # [m] larger of |x| and |y|


def tile(kind, difficulty=1.0, cfg=CFG, seed=0):
    """Return the heights (NODES, NODES) [m] of a tile, rows along y."""
    return tile_heights(cfg, kind, difficulty, np.random.default_rng(seed))


@pytest.mark.parametrize("kind", KINDS)
def test_rim_is_at_zero_the_start_is_level_and_only_flat_is_flat(kind):
    z = tile(kind)
    assert z.shape == (NODES, NODES) and not np.abs(z[OFF > 1.75]).any()
    assert np.ptp(z[OFF < 0.45]) == 0.0
    assert kind == "flat" or np.abs(z).max() > 0.04  # [m]


def test_slope_has_the_configured_angle_times_difficulty_and_bowl_is_its_negative():
    z = tile("slope")
    assert z[20, 30] - z[20, 31] == pytest.approx(0.1 * np.tan(np.radians(15.0)))  # neighbours 0.1 m apart, y = 0
    assert z[20, 20] == pytest.approx((2.0 - 0.3 - 0.5) * np.tan(np.radians(15.0)))  # middle; half tile - rim - start
    np.testing.assert_allclose(tile("bowl", 0.5), -tile("slope", 0.5))
    np.testing.assert_allclose(tile("slope", 0.5), tile("slope") * np.tan(np.radians(7.5)) / np.tan(np.radians(15.0)))


@pytest.mark.parametrize(("difficulty", "step"), [(0.0, 0.03), (1.0, 0.10)])
def test_stairs_pit_and_blocks_have_steps_of_the_difficulty(difficulty, step):
    z = tile("stairs", difficulty)
    assert set(np.round(np.unique(z) / step, 5)) == {0.0, 1.0, 2.0}
    np.testing.assert_array_equal(tile("pit", difficulty), -z)
    assert set(np.round(np.unique(tile("blocks", difficulty)), 6)) == {0.0, step}


@pytest.mark.parametrize("kind", ["uneven", "waves"])
def test_random_ground_has_amplitude_and_is_reproducible_by_seed(kind):
    z = tile(kind, 0.6)
    assert np.abs(z).max() == pytest.approx(0.6 * 0.05)
    np.testing.assert_array_equal(z, tile(kind, 0.6))
    assert np.abs(z - tile(kind, 0.6, seed=1)).max() > 0.01


def test_waves_grow_to_full_height_over_0_3_m_from_the_level_middle():
    """The same waves have a level middle of 0.5 m and of 0.2 m; their ratio at 1 m is due to the scale of heights."""
    late, early = (tile("waves", cfg=replace(CFG, cell=0.05, start=start))[40] for start in (0.5, 0.2))
    at = 40 + np.array([10, 13, 16])  # nodes at x = 0.5, 0.65, 0.8 m
    assert late[at] / early[at] / (late[60] / early[60]) == pytest.approx([0.0, 0.5, 1.0], abs=1e-9)


def test_map_places_tiles_by_row_and_column():
    field = terrain_map(CFG)
    z, edge = heights(field), 10  # cells of the border of 1 m
    assert z.shape == (8 * 40 + 1 + 2 * edge, 2 * 40 + 1 + 2 * edge)
    assert (field.hx, field.hy) == pytest.approx((5.0, 17.0))
    for row in range(2):
        for col, kind in enumerate(KINDS):
            part = z[edge + 40 * col : edge + 40 * col + 41, edge + 40 * row : edge + 40 * row + 41]
            expected = tile_heights(CFG, kind, 0.5 * (row + 1), np.random.default_rng([0, row, col]))
            np.testing.assert_allclose(part, expected, atol=1e-6)
    # kernels' surface of the tile of row 1, column 3 (a slope): middle (2, -2) m, 1 m ahead of it, 1.5 m left of it
    z, slope_x, slope_y = probe(field, [2.0, 2.0 + 1.0, 2.0], [-2.0, -2.0, -2.0 + 1.5]).T
    slope = np.tan(np.radians(15.0))
    assert z == pytest.approx([1.2 * slope, 0.7 * slope, 0.2 * slope], abs=1e-5)
    assert slope_x[1] == pytest.approx(-slope, abs=1e-4) and slope_y[2] == pytest.approx(-slope, abs=1e-4)
