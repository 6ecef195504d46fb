"""Common plots of experiments and suites, from plain arrays, in the style `STYLE`."""

from __future__ import annotations

import io
import textwrap
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from jumper_warp.utils.files import write_atomically
from jumper_warp.utils.metrics import rate
from jumper_warp.viz.style import ACTUAL_COLOR, GOAL_COLOR

STYLE = "jumper_warp.viz.jumper"  # Style sheet jumper_warp/viz/jumper.mplstyle
FAILED = {"color": "black", "marker": "x", "linewidth": 1.0, "clip_on": False}  # Marks of failed trials
BAND = {"color": "C2", "alpha": 0.15}  # Area of success
WINDOW, MOST_WINDOWS, RESAMPLES = (5, 40), 100, 1000
"""Least and largest number of jumps in a window of the running mean; number of windows; bootstrap samples of each."""


@contextmanager
def figure(path: Path, *shape: int, title: str = "", conditions: str = "", **settings: Any) -> Iterator[Any]:
    """Create a plot, yield its axes and, when the block ends, add a legend and write it to `path`.

    The legend has the labels of all axes without their own legend. title, conditions: lines above the axes; shape,
    settings: arguments of `plt.subplots`.
    """
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    with plt.style.context(STYLE):
        fig, axes = plt.subplots(*shape, layout="compressed", **settings)
        lines = [title, *textwrap.wrap(conditions, int(10.5 * fig.get_figwidth()))]
        fig.suptitle("\n".join(filter(None, lines)), x=0.01, horizontalalignment="left", parse_math=False)
        yield axes
        shown = [axis.get_legend_handles_labels() for axis in fig.axes if axis.get_legend() is None]
        entries = {label: handle for handles, labels in shown for handle, label in zip(handles, labels, strict=True)}
        if entries:
            columns = int(fig.get_figwidth() / (0.55 + 0.076 * max(map(len, entries))))
            legend = fig.legend(entries.values(), entries.keys(), loc="outside lower left", ncols=max(columns, 1))
            for text in legend.get_texts():
                text.set_parse_math(False)  # a name may contain $
        data = io.BytesIO()
        fig.savefig(data, format=Path(path).suffix[1:])
        plt.close(fig)
        write_atomically(Path(path), data.getvalue())


@dataclass(frozen=True)
class Published:
    """Results of a sweep of jumps that the paper reports, to plot beside own results."""

    mean_error: float  # [m] Mean error in simulation
    robot: tuple[tuple[float, float, float], ...]
    """[m] Jumps of the robot: command, signed error, and size of an error whose sign is not printed."""
    open_loop: float | None = None  # [m] Apex of the robot's open-loop jump


def plot_sweep(
    path: Path,
    commanded: np.ndarray,
    reached: np.ndarray,
    good: np.ndarray,
    *,
    tolerance: float,
    paper: Published,
    limit: np.ndarray | None = None,
    trained: Mapping[str, Sequence[float]] | None = None,
    labels: tuple[str, str],
    marks: tuple[str, str],
    title: str,
    conditions: str,
) -> None:
    """Plot the errors of a sweep over commanded values, with their running mean.

    Errors beyond the range of the axis are marked at its edge.

    commanded, reached [m], good (bool, success): (jumps,) each; tolerance [m]: largest error of a success; limit [m]:
    apexes of open-loop jumps of the same robots, (jumps,); trained [m]: ranges of commands by label; labels: of the
    axes; marks: labels of good and of other jumps.
    """
    error = reached - commanded
    pad = max(0.05 * np.ptp(commanded), 0.02)
    low = commanded.min() - pad
    high = commanded.max() + pad
    edge = np.clip(1.1 * np.nanmax(np.abs(error), initial=tolerance), 1.5 * tolerance, 2.5 * tolerance)
    with figure(path, figsize=(7.0, 5.5), title=title, conditions=conditions) as axis:
        line = np.array([low, high])
        shown = np.clip(error, -edge, edge)
        axis.fill_between(line, -tolerance, tolerance, **BAND, label=f"within {tolerance:g} m")
        axis.axhline(0.0, color="C2", linewidth=1.0)
        axis.plot(commanded[good], shown[good], "o", color=ACTUAL_COLOR, alpha=0.6, label=marks[0])
        axis.scatter(commanded[~good], shown[~good], **FAILED, label=None if good.all() else marks[1])
        plot_robot(axis, paper.robot)
        if limit is not None:
            order = np.argsort(commanded)
            above = (limit - commanded)[order]
            axis.plot(commanded[order], above, ".", color="0.6", label="open-loop jump of the same robot", zorder=1)
        if paper.open_loop is not None:
            label = "paper, robot: open-loop jump"
            axis.plot(line, paper.open_loop - line, color="0.4", linestyle=":", label=label)
        for sign in (-1.0, 1.0):
            label = f"paper, simulation: mean error {paper.mean_error:g} m"
            axis.axhline(sign * paper.mean_error, color="C1", linestyle="--", linewidth=1.0, label=label)
        plot_running_mean(axis, commanded, error)
        for i, (label, span) in enumerate((trained or {}).items()):
            style = {"color": f"C{3 + i}", "linewidth": 5.0, "solid_capstyle": "butt"}
            axis.plot(span, np.full(2, (0.1 * i - 0.95) * edge), label=label, **style)
        axis.set(xlim=(low, high), ylim=(-edge, edge), xlabel=labels[0], ylabel=labels[1])


def plot_robot(axis: Any, jumps: Sequence[tuple[float, float, float]]) -> None:
    """Plot the errors of the jumps that the paper's real robot made in a sweep (`Published.robot`)."""
    command, error, size = np.array(jumps).T
    style = {"color": "C1", "markersize": 8.0, "markeredgecolor": "black", "capsize": 3.0, "zorder": 3}
    axis.errorbar(command, error, yerr=size, fmt="*", label="paper, robot", **style)


def plot_running_mean(axis: Any, commanded: np.ndarray, error: np.ndarray) -> None:
    """Plot the running mean of errors [m] over commands [m], (jumps,) each, with its 95 % bootstrap interval.

    It shows systematic errors, which single jumps hide. Jumps with a NaN error are left out.
    """
    order = np.argsort(commanded)[~np.isnan(error)[np.argsort(commanded)]]
    if len(order) < WINDOW[0]:
        return
    width = int(np.clip(len(order) // 10, *WINDOW))
    step = max(1, len(order) // MOST_WINDOWS)
    x, windows = (
        np.lib.stride_tricks.sliding_window_view(values[order], width)[::step] for values in (commanded, error)
    )
    draws = np.random.default_rng(0).integers(width, size=(RESAMPLES, width))
    interval = np.quantile(windows[:, draws].mean(axis=-1), (0.025, 0.975), axis=1)
    axis.plot(x.mean(axis=1), windows.mean(axis=1), color="black", label=f"mean of {width} jumps, 95 % interval")
    axis.fill_between(x.mean(axis=1), *interval, color="black", alpha=0.25)


def plot_landings(
    path: Path,
    tests: Mapping[str, tuple[np.ndarray, np.ndarray, np.ndarray]],
    *,
    tolerance: float,
    title: str,
    conditions: str,
    outlines: Mapping[str, tuple[str, np.ndarray]] | None = None,
    magnify: float = 1.0,
) -> None:
    """Plot goals and landing positions from above, relative to the start, one panel per test.

    tests: by title of the panel, goals [m] and landing positions [m], (jumps, 2), and success (jumps,); tolerance [m]:
    largest error of a success; outlines: of platforms, blocks or level ground, by key of `tests`: title that describes
    them, and corners [m] of polygons, (polygons, corners, 2); magnify: factor by which errors are drawn larger.
    """
    from matplotlib.collections import PolyCollection

    points = np.concatenate([np.nan_to_num(np.concatenate(values[:2])) for values in tests.values()])
    (x0, y0) = np.minimum(points.min(axis=0), 0.0)
    (x1, y1) = np.maximum(points.max(axis=0), 0.0)
    margin = (3.0 if outlines else 1.5) * tolerance
    width = max(7.0, 4.5 * len(tests))
    size = (width, (width - 0.9) / len(tests) * (y1 - y0 + 2 * margin) / (x1 - x0 + 2 * margin) + 1.8)
    with figure(
        path, 1, len(tests), sharex=True, sharey=True, squeeze=False, figsize=size, title=title, conditions=conditions
    ) as axes:
        for axis, (name, (goals, landing, good)) in zip(axes[0], tests.items(), strict=True):
            panel, corners = (outlines or {}).get(name, (name, np.zeros((0, 3, 2))))
            style = {"facecolor": "0.93", "edgecolor": "0.4", "linewidth": 1.0, "zorder": 0.5}
            axis.add_collection(PolyCollection(list(corners), **style), autolim=False)
            ends = goals + magnify * (landing - goals)
            if magnify == 1.0:
                disks = regular_polygons(np.unique(goals, axis=0), tolerance)
                style = {"facecolor": "#d9efe8", "label": f"within {tolerance:g} m of a goal", "zorder": 0.6}
                axis.add_collection(PolyCollection(list(disks), **style), autolim=False)
            axis.plot(*np.stack([goals, ends]).transpose(2, 0, 1), color="0.6", linewidth=0.8)
            axis.plot(*goals.T, "+", color=GOAL_COLOR, markersize=7.0, label="goal")
            reached = "landed there" if magnify == 1.0 else f"landed, error drawn {magnify:g} times as large"
            axis.plot(*ends[good].T, "o", color=ACTUAL_COLOR, alpha=0.6, label=reached)
            axis.scatter(*ends[~good].T, **FAILED, label=None if good.all() else "failed")
            axis.plot(0.0, 0.0, "s", color="0.4", label="start")
            axis.set(xlim=(x0 - margin, x1 + margin), ylim=(y0 - margin, y1 + margin), xlabel="ahead [m]")
            axis.set(title=panel, aspect="equal")
        axes[0, 0].set(ylabel="to the left [m]")


def regular_polygons(centers: np.ndarray, radius: float) -> np.ndarray:
    """Return the corners [m], (polygons, 48, 2), of regular polygons around centers [m], (polygons, 2)."""
    angle = np.linspace(0.0, 2.0 * np.pi, 48, endpoint=False)
    return centers[:, None] + radius * np.stack([np.cos(angle), np.sin(angle)], axis=1)


def plot_distances(
    path: Path,
    distances: Sequence[float],
    successes: Mapping[str, np.ndarray],
    errors: np.ndarray,
    *,
    covered: Mapping[str, Sequence[float]],
    reliable: float,
    published: Mapping[str, float],
    conditions: str,
) -> None:
    """Plot success rates, covered distances and errors of bins of distances; success with its 95 % interval.

    distances [m]: middles of the bins; successes (bool) by label, errors [m] (NaN: not counted): (bins, jumps) each;
    covered [m]: mean distances of each bin by label; reliable [1]: rate of a reliable distance; published [m]:
    distances of other works, by name.
    """
    settings = {"figsize": (8.0, 9.5), "sharex": True, "title": "Jumps to far goals", "conditions": conditions}
    with figure(path, 3, 1, height_ratios=(2, 3, 2), **settings) as (top, middle, bottom):
        for marker, (label, good) in zip("o^s", successes.items(), strict=False):
            rates = [rate(row) for row in good]
            low, high = np.array([value.interval for value in rates], dtype=float).T
            top.plot(
                distances, 100.0 * np.array([value.value for value in rates], dtype=float), marker=marker, label=label
            )
            top.fill_between(distances, 100.0 * low, 100.0 * high, alpha=0.15)
        top.axhline(100.0 * reliable, color="0.5", linestyle="--", linewidth=1.0, label="reliable")
        top.set(ylabel="success [%]", ylim=(0.0, 103.0))
        middle.plot(distances, distances, color="0.5", linewidth=1.0, label="goal")
        for (label, values), color in zip(covered.items(), ("black", "C5"), strict=False):
            middle.plot(distances, values, marker=".", color=color, label=label)
        for work, distance in published.items():
            if distance >= distances[0]:
                middle.axhline(distance, color="C4", linestyle="-.", label=f"{work}, {distance:g} m")
        middle.set(ylabel="distance [m]")
        for distance, error in zip(distances, errors, strict=True):
            bottom.plot(np.full(len(error), distance), error, ".", color="0.7", zorder=1, label="jump")
        means = [np.nan if np.isnan(error).all() else np.nanmean(error) for error in errors]
        bottom.plot(distances, means, marker="o", color="black", label="mean")
        bottom.set(xlabel="commanded distance [m]", ylabel="error of successes [m]", ylim=(0.0, None))


def plot_paths(path: Path, paths: dict[str, np.ndarray], goals: Mapping[str, Sequence], conditions: str) -> None:
    """Plot base paths from above, one panel per test, and the goals of tests in which all robots have equal goals.

    paths [m]: result of `BasePaths.in_start_frame` by test; goals [m]: by test, (jumps, 2), each relative to the last.
    """
    limits = [path_limits(values) for values in paths.values()]
    height = 6.2 * sum(np.ptp(y) / np.ptp(x) for x, y in limits)
    settings = {"figsize": (8.0, height + 0.8 * len(paths) + 1.2), "title": "Jumps in a row", "conditions": conditions}
    with figure(path, len(paths), 1, squeeze=False, **settings) as axes:
        for axis, (name, test_paths), (xlim, ylim) in zip(axes[:, 0], paths.items(), limits, strict=True):
            axis.set(xlim=xlim, ylim=ylim, ylabel="left [m]", title=name, aspect="equal")
            for i, base_path in enumerate(test_paths):
                label = None if i else "path of the base"
                axis.plot(*base_path.T, linewidth=0.8, alpha=0.5, color=ACTUAL_COLOR, label=label)
            if name in goals:
                ideal = np.cumsum(goals[name], axis=0)
                axis.plot(*ideal.T, "+", color=GOAL_COLOR, markersize=10.0, zorder=3, label="goal, no error")
        axes[-1, 0].set(xlabel="ahead [m]")


def path_limits(paths: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return x and y limits [m] of a plot of paths [m], (paths, steps, 2).

    The y range is at least x range / 5, so that a straight path's panel, which has equal scales, is not too flat.
    """
    low, high = (limit(paths, axis=(0, 1)) for limit in (np.nanmin, np.nanmax))
    middle = 0.5 * (low + high)
    size = np.maximum(1.1 * (high - low), 0.2)
    size[1] = max(size[1], 0.2 * size[0])
    return middle[0] + size[0] * np.array([-0.5, 0.5]), middle[1] + size[1] * np.array([-0.5, 0.5])
