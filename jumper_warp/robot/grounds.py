"""Grounds to jump from and to land on: platforms, uneven ground, and a block that slides.

Heightfields are for `build_model(ground=...)` and `Simulation(ground=...)`: square, centred on the origin, z = 0 around
it, where the robot starts. Beyond their rim the ground keeps the height of the rim.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from jumper_warp.utils.arrays import real_array
from jumper_warp.utils.checks import check_finite, check_not_negative, check_number, check_positive, check_seed
from jumper_warp.utils.errors import InputError

if TYPE_CHECKING:
    import newton

SIZE = 4.0  # [m] Edge of the square, by default: a jump of 2 m from its middle ends on it
HIGHEST = 100.0  # [m] Largest height of a platform or of uneven ground
MOST_CELLS = 10_000  # Largest number of cells along an edge
CELL = 0.02  # [m] Distance between nodes, by default: less than a paw's radius of 0.025 m


@dataclass(frozen=True)
class BlockCfg:
    """Box in every world that slides on the floor without turning. Each value may be an array, one row per world.

    Floor friction acts under the block's weight and the paws' load. The block passes through steps of a heightfield.
    """

    center: tuple[float, float] | np.ndarray
    """[m] x and y at the start, world."""
    half: tuple[float, float] | np.ndarray = (0.4, 0.4)
    """[m] Half extents along x and y."""
    height: float | np.ndarray = 0.1
    """[m] Height of the top above z = 0."""
    mass: float | np.ndarray = 10.0
    """[kg]"""
    friction: float | np.ndarray = 0.4
    """[1] Coefficient of friction between block and floor."""

    def __post_init__(self) -> None:
        """Raise InputError for no number or pair, an extent or mass not positive, or a friction coefficient below 0."""
        for name, value in vars(self).items():
            array = real_array(value, f"block {name}")
            if name in ("center", "half") and array.shape[-1:] != (2,):
                raise InputError(f"block {name} must be x and y, or have shape (num_worlds, 2), got {value!r:.60}")
            check = {"center": check_finite, "friction": check_not_negative}.get(name, check_positive)
            check(f"block {name}", *array.ravel())

    def per_world(self, num_worlds: int) -> dict[str, np.ndarray]:
        """Return position, size, mass and friction of the block in each world, as arrays by name.

        `center`, `half` (num_worlds, 2) [m], the others (num_worlds,). Raises InputError for arrays of another number
        of worlds.
        """
        shapes = {name: (num_worlds, 2) if name in ("center", "half") else (num_worlds,) for name in vars(self)}
        try:
            return {name: np.broadcast_to(getattr(self, name), shape) for name, shape in shapes.items()}
        except ValueError as error:
            raise InputError(f"block values must be one, or one for each of {num_worlds} worlds: {error}") from None


def platform(height: float, *, edge: float = 0.5, size: float = SIZE, cell: float = CELL) -> newton.Heightfield:
    """Return a heightfield with a step at x = `edge` [m]: z = 0 before it, `height` [m] behind it, negative for a drop.

    The edge moves back to the nearest node, and the wall takes one cell. size: edge of the square [m]; cell: largest
    distance between nodes [m]. Raises InputError: `height` is zero or beyond ±HIGHEST, an edge not between 0 and the
    rim, or as `uneven` for size and cell.
    """
    x = _nodes(size, cell)
    check_number("platform height", height, -HIGHEST, HIGHEST, "m")
    if height == 0.0:
        raise InputError("platform height must not be zero")
    check_number("platform edge", edge, 1.0e-6, 0.5 * size - 1.0e-6, "m")
    return _heightfield(np.tile(np.where(x <= edge + 1.0e-9, 0.0, height), (len(x), 1)), size)


def uneven(
    amplitude: float = 0.05,
    seed: int = 0,
    *,
    flat_radius: float = 0.6,
    length: float = 0.2,
    size: float = SIZE,
    cell: float = CELL,
) -> newton.Heightfield:
    """Return a heightfield of smooth random bumps up to `amplitude` [m], level within `flat_radius` [m] of the origin.

    length: correlation length [m], at which the correlation of two heights is 1/e; the bumps grow to full height within
    two lengths beyond `flat_radius`. size: edge of the square [m]; cell: largest distance between nodes [m]. With the
    defaults slopes reach 20 to 25 degrees.

    Raises InputError: an amplitude above HIGHEST, a length that is not positive or above `size`, more than MOST_CELLS
    cells or less than 2 along an edge, no room beyond `flat_radius`, or no seed.
    """
    x = _nodes(size, cell)
    check_number("amplitude", amplitude, 1.0e-6, HIGHEST, "m")
    check_number("length", length, 1.0e-6, size, "m")
    check_number("flat_radius", flat_radius, 0.0, 0.5 * size - 1.0e-6, "m")
    seed = check_seed(seed)
    bumps = _gaussian_field(np.random.default_rng(seed), len(x), x[1] - x[0], length)
    radius = np.hypot(x[:, None], x[None, :])
    ramp = np.clip((radius - flat_radius) / (2.0 * length), 0.0, 1.0)
    bumps *= ramp * ramp * (3.0 - 2.0 * ramp)
    return _heightfield(bumps * amplitude / np.abs(bumps).max(), size)


def _nodes(size: float, cell: float) -> np.ndarray:
    """Return coordinates of a square ground's grid along one axis [m], -size/2 to size/2, at most `cell` apart."""
    check_number("size", size, 1.0e-3, 1.0e4, "m")
    check_number("cell", cell, size / MOST_CELLS, 0.5 * size, "m")
    return np.linspace(-0.5 * size, 0.5 * size, int(np.ceil(size / cell - 1.0e-9)) + 1)


def _gaussian_field(rng: np.random.Generator, nodes: int, cell: float, length: float) -> np.ndarray:
    """Return smooth random heights (nodes, nodes) with a Gaussian correlation exp(-(distance / length)^2), mean 0.

    White noise is smoothed in the frequency domain, by a filter whose square has the spectrum of that correlation,
    exp(-(wave number * length)^2 / 4). Heights have no unit: the caller scales them. cell: distance of nodes, length:
    correlation length [m].
    """
    padded = nodes + int(np.ceil(4.0 * length / cell))  # the transform is periodic: opposite rims must not correlate
    wave = 2.0 * np.pi * np.fft.fftfreq(padded, cell)
    spectrum = np.exp(-0.125 * length**2 * (wave[:, None] ** 2 + wave[None, :] ** 2))
    return np.fft.ifft2(np.fft.fft2(rng.normal(size=(padded, padded))) * spectrum).real[:nodes, :nodes]


def _heightfield(heights: np.ndarray, size: float) -> newton.Heightfield:
    """Return a Newton heightfield of square ground, edge `size` [m], from heights (n, n) [m], rows along y."""
    import newton

    rows, cols = heights.shape
    half = 0.5 * size
    return newton.Heightfield(data=heights.astype(np.float32), nrow=rows, ncol=cols, hx=half, hy=half)
