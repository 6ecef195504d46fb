"""Least-squares fit to recorded motions by Levenberg-Marquardt; parallel worlds try all dampings of a step at once.

Unknowns are P parameters, z, and the I coordinates of each motion's initial state, all in standard deviations of their
priors: a prior adds the unknown itself as a residual, and the identity matrix to the normal matrix. Residuals are
simulated minus measured values over the noise. Each motion's initial state is eliminated first ("marginalised"), so
that the coupled system has only P unknowns.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from jumper_warp.identification.parameters import ParameterSet, PriorMeasurement
from jumper_warp.identification.replay import MotionReplay
from jumper_warp.identification.residuals import DIFFERENCE, Linearised, MotionResiduals
from jumper_warp.utils.errors import InputError

DAMPINGS = np.array([0.0, 1.0e-3, 1.0e-2, 1.0e-1, 1.0])
"""[1] Dampings relative to the diagonal of the normal matrix; each step tries all of them."""
CAUCHY_WIDTH = 3.0  # width of the Cauchy loss of a robust problem, in typical residuals
PROBE = 0.3  # fraction of a step after which the curvature of the residuals is measured
BLOCK = 16  # rows that `transposed_product` multiplies at once
CHANGE = 0.01
"""Step of a finite difference, in the unknown's posterior standard deviations if all others were known: small against
the accuracy, large against the kinks of friction and contact."""
LARGEST_CHANGE = 0.01  # largest step of a finite difference, in standard deviations of the prior
FINAL_CHANGE = 0.03
"""Step of the final finite differences over other ones: jumps of the residuals on both sides of the minimum lie outside
it. Steps 3 times longer or shorter change standard deviations by less than 0.5 % (robots 5 to 8 of the stream
"development" of `experiments/identification_starts.py`, commit f0759887)."""
FRICTION = "paw_friction"
"""Parameter that can be trapped: while a paw sticks, the motion does not depend on its friction. Costs are compared at
its values `FRICTION_MOVES`, standard deviations of the prior from the minimum."""
FRICTION_MOVES = np.linspace(-2.0, 2.0, 9)


@dataclass
class Point:
    """Values of the unknowns in one optimisation step: parameters and initial states, normalised by their priors."""

    z: np.ndarray  # (P,) parameters
    starts: list[np.ndarray]  # by motion: (I,) coordinates of the initial state


@dataclass
class NormalEquations:
    """Normal equations of the least-squares problem at one iterate.

    Initial states of different motions are coupled only through the parameters. Gradients and matrices are those of
    half the cost. Gradients include the priors. P parameters; each motion has I coordinates and m residuals.
    """

    cost: float  # sum of squares (robust: of losses) of residuals, prior measurements and priors
    data_cost: float  # part of the cost from the residuals alone
    gradient: np.ndarray  # (P,) by the parameters, with prior measurements and priors
    matrix: np.ndarray  # (P, P) Gauss-Newton, with prior measurements, without the priors' identity
    start_gradients: list[np.ndarray]  # by motion: (I,) by its initial state, with its prior
    start_matrices: list[np.ndarray]  # by motion: (I, I) of its initial state, with the prior's identity
    cross_matrices: list[np.ndarray]  # by motion: (P, I) of the parameters and its initial state; priors add nothing
    linearised: list[Linearised]  # by motion: residuals and Jacobian
    weights: list[np.ndarray]  # by motion: (m,) weights of the residuals, 1 unless the problem is robust

    def of_rows(self, index: int, rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return Fisher information (P, P) and score (P,) of the residuals of a motion that `rows`, (m,) bool, selects.

        About the normalised parameters, while the motion's initial state follows them. The score is the gradient of
        half the residuals' cost. index: of the motion.
        """
        linear = self.linearised[index]
        weight = self.weights[index][rows]
        jacobian = linear.jacobian[rows]
        follow = -np.linalg.solve(self.start_matrices[index], self.cross_matrices[index].T)
        along = np.vstack([np.eye(len(self.gradient)), follow])
        information = along.T @ transposed_product(weight[:, None] * jacobian, jacobian) @ along
        score = along.T @ np.einsum("mi,m->i", jacobian, weight * linear.residual[rows])
        return 0.5 * (information + information.T), score

    def following(self, starts: Sequence[np.ndarray], moves: np.ndarray) -> list[np.ndarray]:
        """Return for each motion the initial states (K, I) that fit best after K changes of the parameters, (K, P).

        starts: (I,) by motion, before the moves.
        """
        return [
            start - np.linalg.solve(matrix, cross.T @ moves.T).T
            for start, matrix, cross in zip(starts, self.start_matrices, self.cross_matrices, strict=True)
        ]

    def information(self) -> np.ndarray:
        """Return the data's Fisher information (P, P) about the normalised parameters, initial states marginalised."""
        information = self.matrix.copy()
        for cross, start_matrix in zip(self.cross_matrices, self.start_matrices, strict=True):
            information -= cross @ np.linalg.solve(start_matrix, cross.T)
        return 0.5 * (information + information.T)

    def solve(
        self, damping: float, free: np.ndarray, gradient: np.ndarray, start_gradients: Sequence[np.ndarray]
    ) -> tuple[np.ndarray, list[np.ndarray]]:
        """Return the damped Levenberg-Marquardt step of the parameters and of all initial states.

        Parameters (P,), zero except at `free`; initial states (I,) by motion. damping [1]: relative to the diagonal.
        free: indices of parameters that may move. gradient (P,) and start_gradients ((I,) by motion): right-hand sides.
        """
        matrix = self.matrix[np.ix_(free, free)] + np.eye(len(free))
        matrix += damping * np.diag(np.diag(matrix))
        slope = gradient[free].copy()
        solved = []
        for start_gradient, start_matrix, cross in zip(
            start_gradients, self.start_matrices, self.cross_matrices, strict=True
        ):
            damped = start_matrix + damping * np.diag(np.diag(start_matrix))
            eliminated = np.linalg.solve(damped, np.column_stack([cross[free].T, start_gradient]))
            matrix -= cross[free] @ eliminated[:, :-1]
            slope -= cross[free] @ eliminated[:, -1]
            solved.append(eliminated)
        move = np.zeros(len(gradient))
        move[free] = -np.linalg.solve(matrix, slope)
        return move, [-eliminated[:, -1] - eliminated[:, :-1] @ move[free] for eliminated in solved]


def transposed_product(left: np.ndarray, right: np.ndarray) -> np.ndarray:
    """Return left.T @ right of tall arrays, with the same rounding for any number of threads.

    Shape (a, b) of (m, a) and (m, b), summed in blocks of `BLOCK` rows. BLAS multiplies blocks this small on one
    thread, so that results do not depend on the number of threads.
    """
    product = np.zeros((left.shape[1], right.shape[1]))
    for row in range(0, len(left), BLOCK):
        product += left[row : row + BLOCK].T @ right[row : row + BLOCK]
    return product


class Trial(NamedTuple):
    """Result of one attempted Levenberg-Marquardt step."""

    point: Point  # after the step
    cost: float  # at the point
    damping: float  # [1] the best of `DAMPINGS`; infinite if no step lowers the cost and the point stays
    predicted_decrease: float  # decrease of the cost by the undamped step if the residuals were linear
    residuals: list[np.ndarray]  # by motion: (m,) at the point


def replace_residuals(linearised: Sequence[Linearised], residuals: Sequence[np.ndarray]) -> list[Linearised]:
    """Return linearised motions with other residuals, (m,) by motion, and the same Jacobians."""
    return [Linearised(residual, old.jacobian) for residual, old in zip(residuals, linearised, strict=True)]


class LeastSquares:
    """Least-squares problem of an identification: residuals of motions, prior measurements and parameters' priors."""

    def __init__(
        self,
        parameters: ParameterSet,
        motions: Sequence[MotionResiduals],
        replay: MotionReplay,
        prior_measurements: Sequence[PriorMeasurement] = (),
        robust: bool = False,
    ):
        """Collect the unknowns of the problem; robust: Cauchy loss, in which outliers (late contacts) count less."""
        self.parameters = parameters
        self.motions = motions
        self.replay = replay
        self.prior_measurements, self.robust = prior_measurements, robust
        self._typical = math.inf
        self.count = sum(int(motion.valid.sum()) for motion in motions)  # Number of measured values
        self._low, self._high = parameters.bounds()
        self._change = [np.full(len(parameters) + motion.start_size, DIFFERENCE) for motion in motions]

    def scale(self, normal: NormalEquations) -> float:
        """Return the unit [1] of cost differences: the mean squared residual of the data at `normal`, at least 1."""
        return max(1.0, normal.data_cost / self.count)

    def nominal_point(self) -> Point:
        """Return the point at which each unknown has the mean of its prior."""
        return Point(np.zeros(len(self.parameters)), [np.zeros(motion.start_size) for motion in self.motions])

    def normal(self, point: Point, known: Sequence[Linearised] = ()) -> NormalEquations:
        """Linearise all motions at a point and return the normal equations of a Gauss-Newton step.

        known: residuals and Jacobians of the first motions, not recomputed. Raises InputError: the simulation diverges
        in a motion.
        """
        linearised = list(known)
        for motion, start, change in list(zip(self.motions, point.starts, self._change, strict=True))[len(known) :]:
            linear = motion.linearise(self.replay, point.z, start, change)
            if not np.isfinite(linear.residual).all() or not np.isfinite(linear.jacobian).all():
                name = motion.motion.name
                raise InputError(f"motion {name}: the simulation diverges; check targets, units, signs and base")
            linearised.append(linear)
        return self.assemble(point, linearised)

    def without_jumps(self, point: Point, normal: NormalEquations) -> NormalEquations:
        """Return normal equations at a point with derivatives that ignore discontinuities of the residuals (impacts).

        Residuals jump where a paw strikes in another physics step. A jump beside the point enlarges only one of the
        forward and the backward difference, so the smaller one is taken. Steps are short, because a jump on each side
        would enlarge both. Both differences are computed at the point: a mixture of Jacobians at two points determines
        combinations of parameters that neither does. normal: equations at the point, whose derivatives are kept where
        both differences diverge.
        """
        linearised = []
        for motion, start, change, old in zip(self.motions, point.starts, self._change, normal.linearised, strict=True):
            ahead, behind = (
                motion.linearise(self.replay, point.z, start, sign * FINAL_CHANGE * change).jacobian
                for sign in (1.0, -1.0)
            )
            smaller = np.where(np.abs(behind) < np.abs(ahead), behind, ahead)
            for other in (behind, old.jacobian):  # where a world diverges
                smaller = np.where(np.isfinite(smaller), smaller, other)
            linearised.append(Linearised(old.residual, smaller))
        return self.assemble(point, linearised)

    def assemble(self, point: Point, linearised: Sequence[Linearised]) -> NormalEquations:
        """Assemble the normal equations at a point from residuals and Jacobians of all motions there, `linearised`.

        Also sets the steps of the next finite differences, and of a robust problem the typical residual.
        """
        size = len(self.parameters)
        prior_cost = float(point.z @ point.z) + sum(float(start @ start) for start in point.starts)
        normal = NormalEquations(
            prior_cost, 0.0, point.z.copy(), np.zeros((size, size)), [], [], [], list(linearised), []
        )
        if self.robust:
            every = np.concatenate([linear.residual for linear in linearised])
            self._typical = max(1.0, float(np.median(np.abs(every))) / 0.6745)
        for linear, start, change in zip(linearised, point.starts, self._change, strict=True):
            weight = self._weight(linear.residual)
            square = transposed_product(weight[:, None] * linear.jacobian, linear.jacobian)
            slope = np.einsum("mi,m->i", linear.jacobian, weight * linear.residual)
            normal.weights.append(weight)
            change[:] = np.clip(CHANGE / np.sqrt(1.0 + np.diag(square)), DIFFERENCE, LARGEST_CHANGE)
            normal.data_cost += float(np.sum(self._loss(linear.residual)))
            normal.matrix += square[:size, :size]
            normal.gradient += slope[:size]
            normal.cross_matrices.append(square[:size, size:])
            normal.start_matrices.append(square[size:, size:] + np.eye(len(start)))
            normal.start_gradients.append(slope[size:] + start)
        for residual, slope in self.prior_residuals(point.z):
            normal.matrix += np.outer(slope, slope)
            normal.gradient += slope * residual
            normal.cost += residual**2
        normal.cost += normal.data_cost
        return normal

    def scan(
        self, point: Point, normal: NormalEquations, index: int, moves: np.ndarray
    ) -> tuple[list[Point], np.ndarray]:
        """Try several values of one parameter, all other unknowns refitted to first order; return (points, costs).

        Steps downhill cannot leave a plateau, such as the friction of a paw that sticks. index: of the parameter;
        moves: changes of its z, (K,). Points are a list of K, costs have shape (K,).
        """
        covariance = np.linalg.inv(normal.information() + np.eye(len(point.z)))
        along = covariance[:, index] / covariance[index, index]
        z = np.clip(point.z + moves[:, None] * along, self._low, self._high)
        starts = normal.following(point.starts, z - point.z)
        points = [Point(z[k], [start[k] for start in starts]) for k in range(len(moves))]
        return points, self.costs(z, starts)

    def broyden_update(self, normal: NormalEquations, old: Point, trial: Trial) -> NormalEquations:
        """Return the normal equations after a step, with Jacobians updated by Broyden's formula.

        At `trial`, from the Jacobians of `normal` at `old`. The update is the smallest change with which the Jacobian
        predicts the residuals at `trial`; its norm weighs the unknowns by their curvature. It saves the simulations of
        a finite difference.
        """
        linearised = []
        new = trial.point
        parts = zip(normal.linearised, trial.residuals, old.starts, new.starts, normal.start_matrices, strict=True)
        for linear, residual, old_start, new_start, start_matrix in parts:
            move = np.concatenate([new.z - old.z, new_start - old_start])
            along = np.concatenate([np.diag(normal.matrix) + 1.0, np.diag(start_matrix)]) * move
            along /= max(float(move @ along), 1.0e-300)
            prediction_error = residual - linear.residual - np.einsum("mi,i->m", linear.jacobian, move)
            linearised.append(Linearised(residual, linear.jacobian + prediction_error[:, None] * along))
        return self.assemble(new, linearised)

    def residuals(self, point: Point) -> list[np.ndarray]:
        """Return the residuals of each motion at a point, (m,) by motion."""
        starts = [start[None] for start in point.starts]
        return [residuals[:, 0] for residuals in self._costs(point.z[None], starts)[1]]

    def _weight(self, residual: np.ndarray) -> np.ndarray:
        """Return the weights (m,) that residuals (m,) have in the normal equations: 1, or those of the Cauchy loss.

        The weight is the loss' slope over that of the square: outliers count less (iteratively reweighted squares).
        """
        return 1.0 / (1.0 + (residual / (CAUCHY_WIDTH * self._typical)) ** 2) if self.robust else np.ones_like(residual)

    def _loss(self, residual: np.ndarray) -> np.ndarray:
        """Return the loss of each residual, of any shape: its square, or the Cauchy loss of a robust problem."""
        if not self.robust:
            return residual**2
        limit = CAUCHY_WIDTH * self._typical
        return limit**2 * np.log1p((residual / limit) ** 2)

    def prior_residuals(self, z: np.ndarray) -> list[tuple[float, np.ndarray]]:
        """Return residual over std and gradient (P,) of each prior measurement, such as a weighed mass, at z (P,)."""
        step = 1.0e-6
        robots = self.parameters.robots(np.concatenate([z[None], z + step * np.eye(len(z))]), self.replay.description)
        residuals = []
        for prior in self.prior_measurements:
            residual = (prior.measure(robots) - prior.value) / prior.std
            residuals.append((float(residual[0]), (residual[1:] - residual[0]) / step))
        return residuals

    def costs(self, z: np.ndarray, starts: Sequence[np.ndarray]) -> np.ndarray:
        """Return the costs (K,) of K candidates z (K, P), starts (K, I) by motion; infinite where a world diverges."""
        return self._costs(z, starts)[0]

    def _costs(self, z: np.ndarray, starts: Sequence[np.ndarray]) -> tuple[np.ndarray, list[np.ndarray]]:
        """Return the costs (K,) of K candidate points and the residuals of each motion there, (m, K) by motion."""
        cost = np.sum(z**2, axis=1) + sum(np.sum(start**2, axis=1) for start in starts)
        robots = self.parameters.robots(z, self.replay.description)
        residuals = []
        for prior in self.prior_measurements:
            cost += ((prior.measure(robots) - prior.value) / prior.std) ** 2
        for motion, start in zip(self.motions, starts, strict=True):
            residual = motion.residuals(self.replay, z, start)
            with np.errstate(over="ignore", invalid="ignore"):
                cost += np.sum(self._loss(residual), axis=0)
            residuals.append(residual)
        return np.where(np.isfinite(cost), cost, math.inf), residuals

    def step(self, point: Point, normal: NormalEquations, geodesic: bool = True) -> Trial:
        """Take the best Levenberg-Marquardt step over all damping values; without a lower cost the point stays.

        geodesic: also try each step with geodesic acceleration, which follows the curvature of the residuals.
        """
        free = self._free(point.z, normal.gradient)
        moves = [normal.solve(damping, free, normal.gradient, normal.start_gradients) for damping in DAMPINGS]
        move, starts = moves[0]
        predicted = -float(normal.gradient[free] @ move[free])
        predicted -= sum(float(g @ s) for g, s in zip(normal.start_gradients, starts, strict=True))
        if geodesic:
            moves = moves + self._accelerated(point, normal, free, moves)
        z = np.clip(point.z + np.array([move for move, _ in moves]), self._low, self._high)
        starts = [start + np.array([move[i] for _, move in moves]) for i, start in enumerate(point.starts)]
        trial = self._best_trial(z, starts, predicted)
        if not trial.cost < normal.cost:
            return Trial(point, normal.cost, math.inf, predicted, [linear.residual for linear in normal.linearised])
        return trial

    def _free(self, z: np.ndarray, gradient: np.ndarray) -> np.ndarray:
        """Return the indices of the parameters that may move: not at a bound, or descent leads away from it."""
        return np.flatnonzero(~((z <= self._low) & (gradient > 0.0) | (z >= self._high) & (gradient < 0.0)))

    def _best_trial(self, z: np.ndarray, starts: list[np.ndarray], predicted: float) -> Trial:
        """Return the point with the least cost of K candidates, with its cost and residuals.

        Candidates z (K, P), starts (K, I) by motion. predicted: decrease of the cost predicted by the linear model.
        """
        costs, residuals = self._costs(z, starts)
        best = int(np.argmin(costs))
        moved = Point(z[best], [start[best] for start in starts])
        damping = float(DAMPINGS[best % len(DAMPINGS)])
        return Trial(moved, float(costs[best]), damping, predicted, [residual[:, best] for residual in residuals])

    def _accelerated(
        self, point: Point, normal: NormalEquations, free: np.ndarray, plain: list[tuple[np.ndarray, list[np.ndarray]]]
    ) -> list[tuple[np.ndarray, list[np.ndarray]]]:
        """Add geodesic acceleration to Levenberg-Marquardt steps with different damping.

        plain: step by damping, parameters (P,) and (I,) by motion. Parallel worlds measure the curvature of the
        residuals at the fraction `PROBE` of each step. A step is returned unchanged if its acceleration is longer than
        the step, or a world diverges.
        """
        size = len(point.z)
        ahead = np.clip(point.z + PROBE * np.array([move for move, _ in plain]), self._low, self._high)
        gradient = np.zeros((size, len(plain)))
        start_gradients = []
        for i, (motion, linear, weight) in enumerate(zip(self.motions, normal.linearised, normal.weights, strict=True)):
            move = np.array([start[i] for _, start in plain])
            residual = motion.residuals(self.replay, ahead, point.starts[i] + PROBE * move)
            both = np.concatenate([ahead - point.z, PROBE * move], axis=1)
            with np.errstate(invalid="ignore", over="ignore"):
                straight = np.einsum("mi,ki->mk", linear.jacobian, both)
                curvature = (residual - linear.residual[:, None] - straight) / PROBE**2
                slope = transposed_product(linear.jacobian, weight[:, None] * curvature)
            gradient += slope[:size]
            start_gradients.append(slope[size:])
        accelerated = []
        for k, (move, starts) in enumerate(plain):
            slopes = [slope[:, k] for slope in start_gradients]
            if np.isfinite(gradient[:, k]).all() and all(np.isfinite(slope).all() for slope in slopes):
                more, more_starts = normal.solve(DAMPINGS[k], free, gradient[:, k], slopes)
                if np.linalg.norm(more) < np.linalg.norm(move):
                    move = move + more
                    starts = [a + b for a, b in zip(starts, more_starts, strict=True)]
            accelerated.append((move, starts))
        return accelerated
