"""Statistics over the seeds of two trainings: interquartile mean, bootstrap intervals, exact rank test.

They follow the convention of rliable (Agarwal et al., 2021): a seed is a sample, bands are 95 % percentile bootstrap.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import scipy.stats

RESAMPLES = 2000  # Bootstrap samples
MOST_PERMUTATIONS = 200_000  # Largest number of assignments of seeds to arms that the rank test enumerates
FEWEST_SEEDS = 5  # Below this number of seeds of an arm a table carries a note


def interquartile_mean(values: np.ndarray, axis: int = -1) -> np.ndarray:
    """Return the mean of the middle half of the values along an axis; of fewer than four values the mean."""
    return scipy.stats.trim_mean(values, 0.25, axis=axis)


def bands(values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the 95 % bootstrap interval of the interquartile mean over the first axis: low and high.

    values: (seeds, ...). The ends equal the mean for a single seed.
    """
    if len(values) < 2:
        return values[0], values[0]
    result = scipy.stats.bootstrap(
        (values,), interquartile_mean, axis=0, n_resamples=RESAMPLES, method="percentile", rng=0, vectorized=True
    )
    return result.confidence_interval.low, result.confidence_interval.high


def probability_larger(first: np.ndarray, second: np.ndarray, axis: int = -1) -> np.ndarray:
    """Return the probability [1] that a seed of `first` has a larger value than one of `second`; ties count half.

    Arrays of seeds along `axis`, the last one.
    """
    pairs = np.sign(np.expand_dims(first, -1) - np.expand_dims(second, -2))
    return 0.5 + 0.5 * pairs.mean(axis=(-2, -1))


def probability_interval(first: np.ndarray, second: np.ndarray) -> tuple[float, float] | None:
    """Return the 95 % bootstrap interval of `probability_larger`; None: an arm has one seed."""
    if min(len(first), len(second)) < 2:
        return None
    result = scipy.stats.bootstrap(
        (first, second), probability_larger, n_resamples=RESAMPLES, method="percentile", rng=0, vectorized=True
    )
    return float(result.confidence_interval.low), float(result.confidence_interval.high)


def rank_test(first: np.ndarray, second: np.ndarray) -> float:
    """Return the p-value of the exact two-sided rank test (Mann-Whitney) that two arms are equally good.

    With ties it is the permutation distribution of the statistic, exact up to MOST_PERMUTATIONS. 1 if an arm has one
    seed.
    """
    if min(len(first), len(second)) < 2:
        return 1.0
    tied = len(np.unique([*first, *second])) < len(first) + len(second)
    method: Any = scipy.stats.PermutationMethod(n_resamples=MOST_PERMUTATIONS, rng=0) if tied else "exact"
    return float(scipy.stats.mannwhitneyu(first, second, method=method).pvalue)


def holm(p_values: Sequence[float]) -> list[float]:
    """Return p-values with Holm's correction for their number."""
    order = np.argsort(p_values)
    factors = np.arange(len(p_values), 0, -1)
    corrected = np.minimum(np.maximum.accumulate(factors * np.array(p_values)[order]), 1.0)
    return corrected[np.argsort(order)].tolist()
