"""Systematic standard deviations against refits without a cluster of residuals."""

import numpy as np
import pytest

from jumper_warp.identification.least_squares import NormalEquations
from jumper_warp.identification.residuals import Linearised
from jumper_warp.identification.uncertainty import systematic_std, trapped_variance

PARAMETERS, ROWS, CHANNELS, MOTIONS = 5, 60, 4, 3
CHANNEL = np.arange(CHANNELS).repeat(ROWS // CHANNELS)  # (ROWS,) channel of each residual of a motion


class Refit:
    """Linear least-squares problem with an error that all rows of a channel share; unknowns have priors of std 1.

    Unknowns: PARAMETERS parameters, and `starts` coordinates of the initial state of each motion.
    """

    def __init__(self, starts: int, rng: np.random.Generator):
        self.starts = starts
        self.jacobians = [rng.normal(size=(ROWS, PARAMETERS + starts)) for _ in range(MOTIONS)]
        self.data = [rng.normal(size=ROWS) + rng.normal(size=CHANNELS)[CHANNEL] for _ in range(MOTIONS)]
        self.weights = [rng.uniform(0.2, 1.0, ROWS) for _ in range(MOTIONS)]

    def solve(self, mask):
        """Return parameters (PARAMETERS,) and starts (MOTIONS, starts) fitted to rows in a mask (MOTIONS, ROWS)."""
        matrix = np.eye(PARAMETERS + MOTIONS * self.starts)
        slope = np.zeros(len(matrix))
        for i in range(MOTIONS):
            first = PARAMETERS + i * self.starts
            place = [*range(PARAMETERS), *range(first, first + self.starts)]
            weighed = (self.weights[i] * mask[i])[:, None] * self.jacobians[i]
            matrix[np.ix_(place, place)] += weighed.T @ self.jacobians[i]
            slope[place] += weighed.T @ self.data[i]
        solution = np.linalg.solve(matrix, slope)
        return solution[:PARAMETERS], solution[PARAMETERS:].reshape(MOTIONS, self.starts)

    def normal(self, z, starts):
        """Return the normal equations at parameters z (PARAMETERS,) and starts (MOTIONS, starts)."""
        matrix, cross, start_matrices, linearised = np.zeros((PARAMETERS, PARAMETERS)), [], [], []
        for jacobian, data, weight, start in zip(self.jacobians, self.data, self.weights, starts, strict=True):
            square = jacobian.T @ (weight[:, None] * jacobian)
            matrix += square[:PARAMETERS, :PARAMETERS]
            cross.append(square[:PARAMETERS, PARAMETERS:])
            start_matrices.append(square[PARAMETERS:, PARAMETERS:] + np.eye(self.starts))
            linearised.append(Linearised(jacobian @ np.concatenate([z, start]) - data, jacobian))
        return NormalEquations(0.0, 0.0, z, matrix, [], start_matrices, cross, linearised, self.weights)


@pytest.mark.parametrize(("starts", "rtol"), [(0, 1e-9), (3, 0.15)])  # exact without starts, which are not refitted
def test_systematic_std_matches_refits_without_a_channel_or_a_motion(starts, rtol):
    """The oracle is the jackknife over channels plus the jackknife over motions, each cluster refitted exactly."""
    refit = Refit(starts, np.random.default_rng(0))
    all_rows = np.ones((MOTIONS, ROWS), bool)
    best, best_starts = refit.solve(all_rows)
    normal = refit.normal(best, best_starts)
    std = systematic_std(normal, [CHANNEL] * MOTIONS, np.linalg.inv(normal.information() + np.eye(PARAMETERS)))
    variance = np.zeros(PARAMETERS)
    for groups in ([CHANNEL == c for c in range(CHANNELS)], [np.ones(ROWS, bool)]):
        changes = []
        for motion in range(MOTIONS):
            for rows in groups:
                mask = all_rows.copy()
                mask[motion] &= ~rows
                changes.append(refit.solve(mask)[0] - best)
        variance += (len(changes) - 1) / len(changes) * np.square(changes).sum(0)
    np.testing.assert_allclose(std, np.sqrt(variance), rtol=rtol)


MOVES = np.linspace(-2.0, 2.0, 9)


@pytest.mark.parametrize("std", [0.05, 0.3, 1.0])
def test_linear_model_misses_no_variance_of_a_normal_parameter(std):
    assert trapped_variance(MOVES, (MOVES / std) ** 2, std) == pytest.approx(0.0, abs=1e-12)


def test_linear_model_misses_the_variance_of_paws_that_stick_at_greater_friction():
    """A slipping paw bounds its friction from below, with std 0.05; above the fit, the cost rises to 1, then slowly."""

    def excess(moves):
        return np.where(moves < 0.0, (moves / 0.05) ** 2, np.minimum((moves / 0.05) ** 2, 1.0 + moves**2))

    fine = np.linspace(-2.0, 4.0, 60_001)
    density = np.exp(-0.5 * excess(fine))
    exact = np.sum(density * fine**2) / np.sum(density)  # 0.60^2 around the fit; linear model: 0.05^2
    assert exact > 0.3
    assert np.sqrt(trapped_variance(MOVES, excess(MOVES), 0.05)) == pytest.approx(np.sqrt(exact), rel=0.2)
