"""Plots that several experiments and suites share."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np

from jumper_warp.evaluation.jumps import JumpLog
from jumper_warp.evaluation.landings import LandingLog

matplotlib.use("Agg")
import matplotlib.pyplot as plt


@contextmanager
def figure(path: Path, *shape: int, **settings: Any) -> Iterator[Any]:
    """Yield the axes of a new figure, and write it to `path` on exit; shape, settings: arguments of `plt.subplots`."""
    fig, axes = plt.subplots(*shape, constrained_layout=True, **settings)
    yield axes
    fig.savefig(path, dpi=110)
    plt.close(fig)


def plot_sweep(
    axis: Any, commanded: np.ndarray, reached: np.ndarray, good: np.ndarray, tolerance: float, names: tuple[str, str]
) -> None:
    """Plot reached over commanded values [m] with the band of success onto a matplotlib axis.

    commanded, reached [m], good (bool, success): (jumps, 1) each; tolerance [m]: half width of the band; names: legend
    of the good and of the other jumps.
    """
    line = np.array([commanded.min(), commanded.max()])
    axis.fill_between(
        line, line - tolerance, line + tolerance, color="tab:green", alpha=0.12, label=f"within {tolerance:g} m"
    )
    axis.plot(line, line, color="tab:green", linewidth=1.0, label="commanded")
    axis.scatter(commanded[good], reached[good], s=9, color="tab:blue", label=names[0])
    axis.scatter(commanded[~good], reached[~good], s=14, color="tab:red", marker="x", label=names[1])
    axis.legend(loc="upper left")


def plot_landings(path: Path, tests: dict[str, LandingLog], size: tuple[float, float]) -> None:
    """Plot goals and landing positions of first jumps from above, relative to the start, one panel per test.

    tests: log by title of its panel; size [in]: of the figure.
    """
    with figure(path, 1, len(tests), figsize=size, squeeze=False) as axes:
        for axis, (title, landings) in zip(axes[0], tests.items(), strict=True):
            good, goals, landing = landings.success[:, 0], landings.goal_positions[:, 0], landings.landing[:, 0]
            axis.plot(*np.stack([goals, landing]).transpose(2, 0, 1), color="0.7", linewidth=0.8)
            axis.scatter(goals[:, 0], goals[:, 1], s=20, color="0.4", marker="x", linewidth=0.8, label="goal")
            axis.scatter(landing[good, 0], landing[good, 1], s=12, color="tab:blue", label="landed there")
            axis.scatter(landing[~good, 0], landing[~good, 1], s=14, color="tab:red", label="failed")
            axis.set(xlabel="ahead [m]", ylabel="to the left [m]", title=title, aspect="equal")
        axes[0, 0].figure.legend(*axes[0, 0].get_legend_handles_labels(), loc="outside lower center", ncols=3)


class BasePaths:
    """Recorder of the path of every base; call the object after every policy step."""

    def __init__(self) -> None:
        self.positions: list[np.ndarray] = []  # [m] x, y of every base, one array (worlds, 2) per step, world frame

    def __call__(self, landings: JumpLog) -> None:
        """Append the present base positions; NaN for worlds whose last jump has ended."""
        running = landings.current < landings.goals.shape[1]
        self.positions.append(np.where(running[:, None], landings.arrays["base_pos"][:, :2], np.nan))

    def in_start_frame(self, headings: np.ndarray) -> np.ndarray:
        """Return the paths [m], (worlds, steps, 2), ahead and to the left of the world's origin.

        headings [rad]: of the robots at the start, (worlds,).
        """
        x, y = np.moveaxis(np.stack(self.positions, axis=1), -1, 0)
        cos, sin = np.cos(headings)[:, None], np.sin(headings)[:, None]
        return np.stack([cos * x + sin * y, cos * y - sin * x], axis=-1)


def plot_paths(path: Path, paths: dict[str, np.ndarray], goals: Mapping[str, Sequence], title: str) -> None:
    """Plot base paths from above, one panel per test, with the goals of tests in which all robots have the same.

    paths [m]: by test, of `BasePaths.in_start_frame`; goals [m]: by test, (jumps, 2), each relative to the one before;
    title: suffix of each panel's title.
    """
    with figure(path, 1, len(paths), figsize=(5.0 * len(paths), 4.5)) as axes:
        for axis, (name, test_paths) in zip(axes, paths.items(), strict=True):
            for base_path in test_paths:
                axis.plot(base_path[:, 0], base_path[:, 1], linewidth=0.8, alpha=0.5, color="tab:blue")
            if name in goals:
                ideal = np.cumsum(goals[name], axis=0)
                axis.scatter(*ideal.T, s=50, color="tab:red", marker="x", zorder=3, label="goal, no error")
                axis.legend(loc="upper left")
            axis.set(xlabel="ahead [m]", ylabel="to the left [m]", title=f"{name}, {title}", aspect="equal")
            axis.margins(0.1, 0.3)
