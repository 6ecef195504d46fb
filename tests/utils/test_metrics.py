"""Intervals of metrics against SciPy."""

from types import SimpleNamespace

import numpy as np
import pytest
from scipy import stats

from jumper_warp.utils.metrics import Metric, MetricValue, largest, mean, measure, rate, rmse


@pytest.mark.parametrize(("successes", "trials"), [(0, 7), (3, 7), (7, 7), (4000, 4096)])
def test_interval_of_a_rate_is_wilsons(successes, trials):
    value, number, interval, over = rate(np.arange(trials) < successes, "jumps")
    expected = stats.binomtest(successes, trials).proportion_ci(method="wilson")
    assert (value, number, over) == (successes / trials, trials, "jumps")
    assert interval == pytest.approx((expected.low, expected.high), abs=1e-6)


def test_interval_of_a_mean_agrees_with_scipys_bootstrap_and_ignores_nan():
    values = np.random.default_rng(3).exponential(size=300)
    metric = mean(np.append(values, np.nan))
    expected = stats.bootstrap((values,), np.mean, method="percentile", n_resamples=20_000, random_state=1)
    assert (metric.value, metric.trials) == (pytest.approx(values.mean()), 300)
    assert metric.interval == pytest.approx(expected.confidence_interval, abs=0.01)
    assert mean(values) == mean(values)


def test_rmse_weighs_trials_by_their_samples():
    squares = np.array([[8.0, 2.0], [0.0, 6.0], [0.0, 0.0]])
    metric = rmse(squares, "robots")
    assert (metric.value, metric.trials) == (1.0, 2) and metric.interval == (0.0, 2.0)


@pytest.mark.parametrize("statistic", [rate, mean, largest, lambda values: rmse(np.zeros((0, 2)))])
def test_metric_without_trials_is_undefined(statistic):
    value, trials, interval, _ = statistic(np.zeros(0))
    assert (value, trials, interval) == (None, 0, None)


def test_measure_takes_trials_of_the_set_and_of_the_mask():
    landed, tilt = np.array([True, True, True, False]), np.array([1.0, 5.0, 3.0, 9.0])
    outcome = SimpleNamespace(trials={"landed jumps": landed}, tilt=tilt)
    rows = [Metric("tilt_max_deg", largest, "landed jumps", lambda o: o.tilt)]
    metrics = measure(rows, outcome, np.array([True, False, True, True]), "near_", "to near goals")
    assert metrics == {"near_tilt_max_deg": MetricValue(3.0, 2, None, "landed jumps to near goals")}
