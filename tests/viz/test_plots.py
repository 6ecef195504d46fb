"""Plots: the width of an interval."""

import matplotlib.pyplot as plt
import numpy as np
import pytest

from jumper_warp.viz import plots


def test_interval_of_running_mean_has_the_width_of_the_standard_error():
    error = np.random.default_rng(3).normal(0.0, 0.1, 4000)
    _, axis = plt.subplots()
    plots.plot_running_mean(axis, np.linspace(0.0, 1.0, len(error)), error)
    band = axis.collections[0].get_paths()[0].vertices
    middle = axis.lines[0].get_xdata()[len(axis.lines[0].get_xdata()) // 2]
    low, high = np.ptp(band[np.isclose(band[:, 0], middle), 1]), 2 * 1.96 * 0.1 / np.sqrt(plots.WINDOW[1])
    plt.close()
    assert low == pytest.approx(high, rel=0.3)
