"""Terrain map of square tiles: difficulty grows along x, and the kind of ground changes along y.

A curriculum moves a robot to a harder row after a success, and to an easier one after a fall. World z is up.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from jumper_warp.robot.grounds import MOST_CELLS
from jumper_warp.utils.checks import check_types
from jumper_warp.utils.errors import InputError

if TYPE_CHECKING:
    import newton

KINDS = ("flat", "uneven", "waves", "slope", "bowl", "stairs", "pit", "blocks")  # Kinds of tiles


@dataclass(frozen=True)
class TerrainCfg:
    """Settings of a terrain map of square tiles: size, difficulty and kinds of ground.

    Rows (along x) have growing difficulty, and there is a column (along y) for each entry of `kinds`.
    """

    rows: int = 10
    """Number of difficulties: row i has (i + 1) / rows of the heights and slopes below; 0: no map."""
    kinds: tuple[str, ...] = KINDS
    """Kind of each column."""
    tile: float = 8.0
    """[m] Edge of a tile, whose middle is level, for the start, and whose rim is at z = 0."""
    uneven: float = 0.05
    """[m] Largest height or depth of random ground."""
    slope: float = 15.0
    """[deg] Steepness of slopes and bowls in the last row."""
    step: tuple[float, float] = (0.03, 0.10)
    """[m] Height of steps, in the first row and in the last."""
    start: float = 0.7
    """[m] Half the edge of the level middle."""
    rim: float = 0.3
    """[m] Width of the level rim."""
    border: float = 6.0
    """[m] Width of the level ground around all tiles."""
    cell: float = 0.04
    """[m] Largest distance between nodes, over which a step rises."""
    seed: int = 0
    """Seed of random ground."""

    def __post_init__(self) -> None:
        """Raise InputError if a count, length or slope of the map is out of range, or a kind of ground is unknown."""
        check_types("terrain", self)
        if self.rows < 0 or self.seed < 0:
            raise InputError(f"terrain rows and seed must not be negative, got {self.rows}, {self.seed}")
        for kind in self.kinds or ("",):
            check_kind(kind)
        for name in ("tile", "cell", "start", "rim", "border"):
            if not 0.0 < getattr(self, name) < math.inf:
                raise InputError(f"terrain {name} must be positive and finite, got {getattr(self, name)}")
        if self.start + self.rim >= 0.5 * self.tile or self.cell > 0.25 * self.start:
            raise InputError(f"terrain start, rim and cell must fit in a tile of {self.tile} m")
        edge = (max(self.rows, len(self.kinds)) * self.tile + 2.0 * self.border) / self.cell
        if edge > MOST_CELLS:
            raise InputError(f"a terrain may have {MOST_CELLS} cells along an edge, got {edge:.0f}")
        if not 0.0 <= self.uneven < 1.0 or not 0.0 <= self.slope < 60.0:
            raise InputError(
                f"terrain uneven must be in [0, 1) m, slope in [0, 60) deg, got {self.uneven}, {self.slope}"
            )
        if not 0.0 < self.step[0] <= self.step[1] < 1.0:
            raise InputError(f"terrain step must be (lower, upper) in (0, 1) m, got {self.step}")

    @classmethod
    def none(cls) -> TerrainCfg:
        """Return a configuration without a terrain map."""
        return cls(rows=0)

    @property
    def cols(self) -> int:
        """Number of tile columns, one for each entry of `kinds`, 0 without a map."""
        return len(self.kinds) if self.rows else 0


def terrain_map(cfg: TerrainCfg) -> newton.Heightfield:
    """Build the terrain map of all tiles as a heightfield centred on the origin, its data indexed [y, x].

    The tile of row i and column j has its middle at x = (i + 1/2 - rows/2) tile, y = (j + 1/2 - cols/2) tile.
    Raises InputError for a configuration without rows.
    """
    import newton

    if cfg.rows == 0:
        raise InputError("a map needs at least one row")
    nodes = math.ceil(cfg.tile / cfg.cell - 1.0e-9)
    cell = cfg.tile / nodes
    edge = math.ceil(cfg.border / cell)
    heights = np.zeros((cfg.cols * nodes + 1 + 2 * edge, cfg.rows * nodes + 1 + 2 * edge), dtype=np.float32)
    for i in range(cfg.rows):
        for j, kind in enumerate(cfg.kinds):
            y = edge + j * nodes
            x = edge + i * nodes
            rng = np.random.default_rng([cfg.seed, i, j])
            heights[y : y + nodes + 1, x : x + nodes + 1] = tile_heights(cfg, kind, (i + 1) / cfg.rows, rng)
    rows, cols = heights.shape
    return newton.Heightfield(
        data=heights, nrow=rows, ncol=cols, hx=0.5 * cell * (cols - 1), hy=0.5 * cell * (rows - 1)
    )


def single_tile(cfg: TerrainCfg, kind: str) -> newton.Heightfield:
    """Build one terrain tile of full difficulty, centred on the origin. Raises InputError for a kind not in `KINDS`."""
    import newton

    check_kind(kind)
    heights = tile_heights(cfg, kind, 1.0, np.random.default_rng(cfg.seed)).astype(np.float32)
    half = 0.5 * cfg.tile
    return newton.Heightfield(data=heights, nrow=len(heights), ncol=len(heights), hx=half, hy=half)


def check_kind(kind: str) -> None:
    """Raise InputError for an unknown kind of terrain tile."""
    if kind not in KINDS:
        raise InputError(f"terrain must be one of {', '.join(KINDS)}, got {kind!r:.40}")


def tile_heights(cfg: TerrainCfg, kind: str, difficulty: float, rng: np.random.Generator) -> np.ndarray:
    """Return the heights [m] of a terrain tile's nodes, (n, n) indexed [y, x], 0 on its rim; difficulty: 0 to 1."""
    nodes = math.ceil(cfg.tile / cfg.cell - 1.0e-9) + 1
    axis = np.linspace(-0.5 * cfg.tile, 0.5 * cfg.tile, nodes)
    return _SHAPES[kind](_Tile(cfg, difficulty, rng, *np.meshgrid(axis, axis)))


class _Tile(NamedTuple):
    """Terrain tile under construction: methods return the heights of its grid nodes, one method per kind of ground."""

    cfg: TerrainCfg
    difficulty: float  # 0 to 1
    rng: np.random.Generator
    x: np.ndarray  # (n, n) [m], of nodes, from the middle
    y: np.ndarray  # (n, n) [m]

    @property
    def off(self) -> np.ndarray:
        """Distance of each node from the tile's middle, (n, n) [m]: the larger of |x| and |y|."""
        return np.maximum(np.abs(self.x), np.abs(self.y))

    @property
    def reach(self) -> float:
        """Distance [m] from the tile's middle to the inner edge of its level rim."""
        return 0.5 * self.cfg.tile - self.cfg.rim

    @property
    def step(self) -> float:
        """Height of a stair or block [m] at this difficulty."""
        return self.cfg.step[0] + self.difficulty * (self.cfg.step[1] - self.cfg.step[0])

    def slope(self) -> np.ndarray:
        """Return the heights (n, n) [m] of a slope from the rim up to the level middle."""
        return math.tan(math.radians(self.difficulty * self.cfg.slope)) * self._inward()

    def stairs(self) -> np.ndarray:
        """Return the heights (n, n) [m] of stairs from the rim up to the level middle, treads 0.6 m deep."""
        return self.step * np.floor(self._inward() / 0.6 + 1.0e-6)

    def _inward(self) -> np.ndarray:
        """Return how far inside the rim each node is, (n, n) [m], at most as far as the level middle begins."""
        return np.clip(self.reach - self.off, 0.0, self.reach - self.cfg.start)

    def waves(self, shortest: float, longest: float, count: int) -> np.ndarray:
        """Return the heights (n, n) [m] of the sum of `count` plane waves of random direction and wavelength [m].

        Rim and middle are level; over 0.3 m the waves grow to full height, which is `difficulty * cfg.uneven`.
        """
        total = np.zeros_like(self.x)
        for length in self.rng.uniform(shortest, longest, count):
            angle, phase = self.rng.uniform(0.0, 2.0 * math.pi, 2)
            along = math.cos(angle) * self.x + math.sin(angle) * self.y
            total += math.sqrt(length) * np.sin(2.0 * math.pi * along / length + phase)
        ramp = np.clip(np.minimum(self.reach - self.off, self.off - self.cfg.start) / 0.3, 0.0, 1.0)
        total *= ramp * ramp * (3.0 - 2.0 * ramp)
        return total / np.abs(total).max() * self.difficulty * self.cfg.uneven

    def blocks(self) -> np.ndarray:
        """Return the heights (n, n) [m] of squares of 0.5 m, each raised by a step with probability 1/2."""
        raised = self.rng.integers(0, 2, (64, 64))
        square = raised[np.floor(self.y / 0.5).astype(int) + 32, np.floor(self.x / 0.5).astype(int) + 32]
        return self.step * square * ((self.off > self.cfg.start) & (self.off < self.reach))


_SHAPES: dict[str, Callable[[_Tile], np.ndarray]] = {
    "flat": lambda tile: np.zeros_like(tile.x),
    "uneven": lambda tile: tile.waves(0.3, 1.2, 40),
    "waves": lambda tile: tile.waves(1.0, 4.0, 6),
    "slope": _Tile.slope,
    "bowl": lambda tile: -tile.slope(),
    "stairs": _Tile.stairs,
    "pit": lambda tile: -tile.stairs(),
    "blocks": _Tile.blocks,
}
