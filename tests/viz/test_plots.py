"""Plots: the width of an interval."""

import matplotlib.pyplot as plt
import numpy as np
import pytest

from jumper_warp.viz import plots


def test_interval_of_running_mean_has_the_width_of_the_standard_error():
    error = np.random.default_rng(3).normal(0.0, 0.1, 4000)
    _, axis = plt.subplots()
    plots.plot_running_mean(axis, np.linspace(0.0, 1.0, len(error)), error)
    band, line = axis.collections[0].get_paths()[0].vertices, axis.lines[0].get_xdata()
    width = np.ptp(band[np.isclose(band[:, 0], line[len(line) // 2]), 1])
    plt.close()
    assert width == pytest.approx(2 * 1.96 * 0.1 / np.sqrt(plots.WINDOW[1]), rel=0.3)
