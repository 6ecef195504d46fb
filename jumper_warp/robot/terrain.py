"""A map of grounds to walk on: square tiles, harder ones with growing x, of another kind with growing y."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import newton
import numpy as np

from jumper_warp.utils.errors import InputError

KINDS = ("flat", "uneven", "waves", "slope", "bowl", "stairs", "pit", "blocks")
"""Of tiles."""


@dataclass(frozen=True)
class TerrainCfg:
    """A map: rows of growing difficulty, a column for each kind of ground, or several."""

    rows: int = 10
    """Levels of difficulty, from a tenth of the heights and slopes below to all of them; 0: no map."""
    kinds: tuple[str, ...] = KINDS
    """Of the columns."""
    tile: float = 8.0
    """[m] Edge of a tile. Its middle is level, for the start; its rim is at z = 0."""
    uneven: float = 0.05
    """[m] Largest height or depth of random ground."""
    slope: float = 15.0
    """[deg]"""
    step: tuple[float, float] = (0.03, 0.10)
    """[m] Height of steps, in the first row and in the last."""
    start: float = 0.7
    """[m] Half the edge of the level middle."""
    rim: float = 0.3
    """[m] Width of the level rim."""
    border: float = 6.0
    """[m] Of level ground around all tiles."""
    cell: float = 0.04
    """[m] Distance between nodes, at most; steps are as wide as this."""
    seed: int = 0
    """Of random ground."""

    def __post_init__(self) -> None:
        """Raises ValueError: a length or a slope is out of range."""
        if self.rows < 0 or self.seed < 0:
            raise InputError(f"terrain rows and seed must not be negative, got {self.rows}, {self.seed}")
        for kind in self.kinds or ("",):
            check_kind(kind)
        for name in ("tile", "cell", "start", "rim", "border"):
            if not 0.0 < getattr(self, name) < math.inf:
                raise InputError(f"terrain {name} must be positive and finite, got {getattr(self, name)}")
        if self.start + self.rim >= 0.5 * self.tile or self.cell > 0.25 * self.start:
            raise InputError(f"terrain start, rim and cell must fit in a tile of {self.tile} m")
        if not 0.0 <= self.uneven < 1.0 or not 0.0 <= self.slope < 60.0:
            raise InputError(
                f"terrain uneven must be in [0, 1) m, slope in [0, 60) deg, got {self.uneven}, {self.slope}"
            )
        if not 0.0 < self.step[0] <= self.step[1] < 1.0:
            raise InputError(f"terrain step must be (lower, upper) in (0, 1) m, got {self.step}")

    @classmethod
    def none(cls) -> TerrainCfg:
        """Return the configuration of no map."""
        return cls(rows=0)

    @property
    def cols(self) -> int:
        """Number of columns, 0 without a map."""
        return len(self.kinds) if self.rows else 0


def terrain_map(cfg: TerrainCfg) -> newton.Heightfield:
    """Return the map as a heightfield centred on the origin.

    The tile of row i and column j has its middle at x = (i + 1/2 - rows/2) tile, y = (j + 1/2 - cols/2) tile.
    Raises ValueError for a configuration without rows.
    """
    if cfg.rows == 0:
        raise InputError("a map needs at least one row")
    nodes = math.ceil(cfg.tile / cfg.cell - 1.0e-9)
    cell = cfg.tile / nodes
    edge = math.ceil(cfg.border / cell)
    heights = np.zeros((cfg.cols * nodes + 1 + 2 * edge, cfg.rows * nodes + 1 + 2 * edge), dtype=np.float32)
    for i in range(cfg.rows):
        for j, kind in enumerate(cfg.kinds):
            y, x = edge + j * nodes, edge + i * nodes
            rng = np.random.default_rng([cfg.seed, i, j])
            heights[y : y + nodes + 1, x : x + nodes + 1] = tile_heights(cfg, kind, (i + 1) / cfg.rows, rng)
    half_x, half_y = (0.5 * cell * (size - 1) for size in (heights.shape[1], heights.shape[0]))
    return newton.Heightfield(data=heights, nrow=heights.shape[0], ncol=heights.shape[1], hx=half_x, hy=half_y)


def single_tile(cfg: TerrainCfg, kind: str) -> newton.Heightfield:
    """Return one tile of full difficulty as a heightfield centred on the origin. Raises ValueError for another kind."""
    check_kind(kind)
    heights = tile_heights(cfg, kind, 1.0, np.random.default_rng(cfg.seed)).astype(np.float32)
    half = 0.5 * cfg.tile
    return newton.Heightfield(data=heights, nrow=len(heights), ncol=len(heights), hx=half, hy=half)


def check_kind(kind: str) -> None:
    """Raise InputError unless there are such tiles."""
    if kind not in KINDS:
        raise InputError(f"terrain must be one of {', '.join(KINDS)}, got {kind!r:.40}")


def tile_heights(cfg: TerrainCfg, kind: str, difficulty: float, rng: np.random.Generator) -> np.ndarray:
    """Return the heights [m] of a tile's nodes, rows along y, 0 on its rim; difficulty: 0 to 1."""
    nodes = math.ceil(cfg.tile / cfg.cell - 1.0e-9) + 1
    axis = np.linspace(-0.5 * cfg.tile, 0.5 * cfg.tile, nodes)
    x, y = np.meshgrid(axis, axis)
    return _SHAPES[kind](cfg, difficulty, rng, x, y)


def _inward(cfg: TerrainCfg, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Return the way [m] from the rim towards the level middle, which it does not enter."""
    off = np.maximum(np.abs(x), np.abs(y))
    return np.clip(0.5 * cfg.tile - cfg.rim - off, 0.0, 0.5 * cfg.tile - cfg.rim - cfg.start)


def _blend(cfg: TerrainCfg, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Return a share that is 0 on the rim and in the level middle, and 1 from 0.3 m away from them."""
    off = np.maximum(np.abs(x), np.abs(y))
    share = np.clip(np.minimum(0.5 * cfg.tile - cfg.rim - off, off - cfg.start) / 0.3, 0.0, 1.0)
    return share * share * (3.0 - 2.0 * share)


def _flat(cfg: TerrainCfg, difficulty: float, rng: np.random.Generator, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    return np.zeros_like(x)


def _waves_of(
    cfg: TerrainCfg, difficulty: float, rng: np.random.Generator, x: np.ndarray, y: np.ndarray, lengths: np.ndarray
) -> np.ndarray:
    """Return a sum of plane waves in any direction, wavelengths [m] as given, as high and deep as they may be."""
    total = np.zeros_like(x)
    for length in lengths:
        angle, phase = rng.uniform(0.0, 2.0 * math.pi, 2)
        along = math.cos(angle) * x + math.sin(angle) * y
        total += math.sqrt(length) * np.sin(2.0 * math.pi * along / length + phase)
    total *= _blend(cfg, x, y)
    return total / np.abs(total).max() * difficulty * cfg.uneven


def _uneven(cfg: TerrainCfg, difficulty: float, rng: np.random.Generator, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    return _waves_of(cfg, difficulty, rng, x, y, rng.uniform(0.3, 1.2, 40))


def _waves(cfg: TerrainCfg, difficulty: float, rng: np.random.Generator, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    return _waves_of(cfg, difficulty, rng, x, y, rng.uniform(1.0, 4.0, 6))


def _slope(cfg: TerrainCfg, difficulty: float, rng: np.random.Generator, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    return math.tan(math.radians(difficulty * cfg.slope)) * _inward(cfg, x, y)


def _bowl(cfg: TerrainCfg, difficulty: float, rng: np.random.Generator, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    return -_slope(cfg, difficulty, rng, x, y)


def _step(cfg: TerrainCfg, difficulty: float) -> float:
    """Return the height of steps [m]."""
    return cfg.step[0] + difficulty * (cfg.step[1] - cfg.step[0])


def _stairs(cfg: TerrainCfg, difficulty: float, rng: np.random.Generator, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    return _step(cfg, difficulty) * np.floor(_inward(cfg, x, y) / 0.6 + 1.0e-6)


def _pit(cfg: TerrainCfg, difficulty: float, rng: np.random.Generator, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    return -_stairs(cfg, difficulty, rng, x, y)


def _blocks(cfg: TerrainCfg, difficulty: float, rng: np.random.Generator, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Return squares of 0.5 m, half of them a step high."""
    raised = rng.integers(0, 2, (64, 64))
    square = raised[np.floor(y / 0.5).astype(int) + 32, np.floor(x / 0.5).astype(int) + 32]
    off = np.maximum(np.abs(x), np.abs(y))
    outside = (off > cfg.start) & (off < 0.5 * cfg.tile - cfg.rim)
    return _step(cfg, difficulty) * square * outside


_SHAPES: dict[str, Callable[..., np.ndarray]] = {
    "flat": _flat, "uneven": _uneven, "waves": _waves, "slope": _slope, "bowl": _bowl, "stairs": _stairs,
    "pit": _pit, "blocks": _blocks,
}  # fmt: skip
