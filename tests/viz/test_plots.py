"""Plots: errors below sweeps, intervals, outlines of grounds, legends outside the data."""

import matplotlib.pyplot as plt
import numpy as np
import pytest

from jumper_warp.viz import plots


@pytest.fixture
def drawn(monkeypatch, tmp_path):
    """Return a function that calls a plotting function with a path and returns the axes of the plot."""
    figures = []
    monkeypatch.setattr(plt, "close", figures.append)

    def draw(plot, *args, **keywords):
        plot(tmp_path / "plot.png", *args, **keywords)
        assert (tmp_path / "plot.png").stat().st_size > 5000
        return figures[-1].axes

    return draw


def sweep(drawn, error, good):
    """Return the axes of a sweep of heights commanded from 0.5 to 1.2 m; error [m] (n,), good: (n,) of bool."""
    commanded = np.linspace(0.5, 1.2, len(error))
    return drawn(
        plots.plot_sweep, commanded, commanded + error, good, tolerance=0.1, marks=("reached", "missed"), title="",
        paper=plots.Published(0.04, ((0.75, 0.0, 0.023), (1.0, 0.01, 0.0)), 1.075), labels=("x", "y"), conditions="",
    )  # fmt: skip


def line(axis, label):
    """Return the line of an axis with a label."""
    return next(line for line in axis.lines if line.get_label() == label)


def test_sweep_shows_errors_and_the_open_loop_jump_as_an_error(drawn):
    error = np.linspace(-0.15, 0.05, 30)
    (axis,) = sweep(drawn, error, error > -0.1)
    np.testing.assert_allclose(line(axis, "reached").get_ydata(), error[error > -0.1], atol=1e-12)
    limit = line(axis, "paper, robot: open-loop jump")
    np.testing.assert_allclose(np.sum(limit.get_xydata(), axis=1), 1.075)  # command + error [m]


def test_interval_of_running_mean_has_the_width_of_the_standard_error():
    error = np.random.default_rng(3).normal(0.0, 0.1, 4000)
    _, axis = plt.subplots()
    plots.plot_running_mean(axis, np.linspace(0.0, 1.0, len(error)), error)
    band = axis.collections[0].get_paths()[0].vertices
    middle = axis.lines[0].get_xdata()[len(axis.lines[0].get_xdata()) // 2]
    low, high = np.ptp(band[np.isclose(band[:, 0], middle), 1]), 2 * 1.96 * 0.1 / np.sqrt(plots.WINDOW[1])
    plt.close()
    assert low == pytest.approx(high, rel=0.3)
