"""Learning curves of a training: lines of its metrics file, grouped by what viewers plot together."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from jumper_warp.rl.metrics_file import METRICS_FILE, logged_line

GROUPS = {
    "Train/mean_reward": "reward", "Metrics/": "metrics", "Episode_Termination/": "terminations",
    "Curriculum/": "curriculum", "Episode_Reward/": "reward terms", "Episode_Sum/": "reward terms",
    "Loss/": "losses", "Perf/total_fps": "speed",
}  # fmt: skip
"""Group of curves by the beginning of the metric's name; other metrics are not shown."""


class MetricsTail:
    """Reader of the lines that a training appends to its metrics file."""

    def __init__(self, folder: Path) -> None:
        """Begin at the start of the file, which may not exist yet; folder: of the run."""
        self._path = folder / METRICS_FILE
        self._read = 0

    def lines(self) -> list[dict[str, Any]]:
        """Return the complete lines since the last call, without malformed ones."""
        if not self._path.is_file():
            return []
        with self._path.open("rb") as file:
            file.seek(self._read)
            content = file.read()
        end = content.rfind(b"\n") + 1
        self._read += end
        return [metrics for line in content[:end].splitlines() if (metrics := logged_line(line))]


def curves_of(lines: Sequence[dict[str, Any]], label: str = "") -> dict[tuple[str, str], list[tuple[float, float]]]:
    """Return points (training time [s], value) by group and name of the curve; label: ends each name."""
    curves: dict[tuple[str, str], list[tuple[float, float]]] = {}
    for line in lines:
        for name, value in line.items():
            group = next((group for start, group in GROUPS.items() if name.startswith(start)), None)
            if group is not None and value is not None:
                curve = curves.setdefault((group, name.split("/")[-1] + label), [])
                curve.append((line.get("Perf/elapsed_s") or 0.0, value))
    return curves
