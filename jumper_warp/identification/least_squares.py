"""Levenberg-Marquardt on recorded motions: many damping values are tried at once as parallel worlds."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from jumper_warp.identification.parameters import ParameterSet
from jumper_warp.identification.replay import Replay
from jumper_warp.identification.residuals import DIFFERENCE, Linearised, MotionResiduals
from jumper_warp.robot.values import RobotValues
from jumper_warp.utils.errors import InputError

DAMPINGS = np.array([0.0, 1.0e-3, 1.0e-2, 1.0e-1, 1.0])
"""Relative to the diagonal of the normal matrix; all are tried in each step."""
ROBUST = 3.0
"""Residuals beyond so many times the typical one count less and less while the optimisation is robust (Cauchy)."""
PROBE = 0.3
"""Share of a step after which its curvature is measured."""
BLOCK = 16
"""Rows of a block of a sum of products."""
CHANGE = 0.01
"""Step of a difference, in deviations that the data alone would leave to the unknown, the others known: small against
what matters, large against the kinks of friction and contact."""
LARGEST_CHANGE = 0.01
"""The same at most, in deviations of the prior."""


@dataclass(frozen=True)
class Knowledge:
    """Something that is known of the robot besides its motions, such as what it weighs."""

    name: str
    measure: Callable[[RobotValues], np.ndarray]
    """Returns what N robots would show, (N,)."""
    value: float
    deviation: float


@dataclass
class Point:
    """Where the optimisation stands, normalised."""

    z: np.ndarray
    """(P,) parameters."""
    starts: list[np.ndarray]
    """(I,) of each motion."""


@dataclass
class Normal:
    """The normal equations at a point; the starts of different motions are coupled through the parameters only."""

    cost: float
    """Sum of squares of residuals, knowledge and priors."""
    data_cost: float
    """Of residuals alone."""
    gradient: np.ndarray
    """(P,)"""
    matrix: np.ndarray
    """(P, P), without the prior's identity."""
    start_gradients: list[np.ndarray]
    """(I,) each."""
    start_matrices: list[np.ndarray]
    """(I, I) each, with the prior's identity."""
    mixed: list[np.ndarray]
    """(P, I) each."""
    linearised: list[Linearised]
    """Of each motion."""
    weights: list[np.ndarray]
    """(m,) of the residuals of each motion."""

    def information(self) -> np.ndarray:
        """Return what data and knowledge say of the parameters, the starts unknown: (P, P), prior deviations."""
        found = self.matrix.copy()
        for mixed, own in zip(self.mixed, self.start_matrices, strict=True):
            found -= mixed @ np.linalg.solve(own, mixed.T)
        return 0.5 * (found + found.T)

    def solve(
        self, damping: float, free: np.ndarray, gradient: np.ndarray, start_gradients: Sequence[np.ndarray]
    ) -> tuple[np.ndarray, list[np.ndarray]]:
        """Return the damped step of parameters (those of index `free`) and starts for a gradient."""
        matrix = self.matrix[np.ix_(free, free)] + np.eye(len(free))
        matrix += damping * np.diag(np.diag(matrix))
        slope = gradient[free].copy()
        solved = []
        for of_start, own, mixed in zip(start_gradients, self.start_matrices, self.mixed, strict=True):
            own = own + damping * np.diag(np.diag(own))
            both = np.linalg.solve(own, np.column_stack([mixed[free].T, of_start]))
            matrix -= mixed[free] @ both[:, :-1]
            slope -= mixed[free] @ both[:, -1]
            solved.append(both)
        move = np.zeros(len(gradient))
        move[free] = -np.linalg.solve(matrix, slope)
        return move, [-both[:, -1] - both[:, :-1] @ move[free] for both in solved]


def gram(left: np.ndarray, right: np.ndarray) -> np.ndarray:
    """Return left.T @ right of tall arrays, (m, a) and (m, b), summed in blocks.

    The bits depend on no number of threads, and blocks this small take one, which need not wait for another.
    """
    found = np.zeros((left.shape[1], right.shape[1]))
    for row in range(0, len(left), BLOCK):
        found += left[row : row + BLOCK].T @ right[row : row + BLOCK]
    return found


class Trial(NamedTuple):
    """Where a step leads."""

    point: Point
    cost: float
    damping: float
    """Infinite if the point stays."""
    promise: float
    """Decrease of the cost that the undamped step would bring if everything were linear."""
    residuals: list[np.ndarray]
    """(m,) of each motion."""


class LeastSquares:
    """The problem: motions, parameters with priors, further knowledge, and the worlds that evaluate them."""

    def __init__(
        self,
        parameters: ParameterSet,
        motions: Sequence[MotionResiduals],
        replay: Replay,
        knowledge: Sequence[Knowledge] = (),
        robust: bool = False,
    ):
        """Lay out the unknowns.

        robust: residuals that stand out count less: where a paw strikes a moment too late, all are wrong.
        """
        self.parameters, self.motions, self.replay, self.knowledge = parameters, motions, replay, knowledge
        self.robust = robust
        self._typical = math.inf
        self.count = sum(int(motion.valid.sum()) for motion in motions)
        """Number of measured values."""
        self._low, self._high = parameters.bounds()
        self._change = [np.full(len(parameters) + motion.start_size, DIFFERENCE) for motion in motions]

    def expected(self) -> Point:
        """Return the point where all unknowns are as expected."""
        return Point(np.zeros(len(self.parameters)), [np.zeros(motion.start_size) for motion in self.motions])

    def normal(self, point: Point, known: Sequence[Linearised] = ()) -> Normal:
        """Return the normal equations at a point; known: what the first motions have there already.

        Raises InputError if it cannot be simulated.
        """
        linearised = list(known)
        for motion, start, change in list(zip(self.motions, point.starts, self._change, strict=True))[len(known) :]:
            found = motion.linearise(self.replay, point.z, start, change)
            if not np.isfinite(found.residual).all() or not np.isfinite(found.jacobian).all():
                raise InputError(
                    f"motion {motion.motion.name}: the model breaks in it; check targets, units, signs and base"
                )
            linearised.append(found)
        return self.assemble(point, linearised)

    def assemble(self, point: Point, linearised: Sequence[Linearised]) -> Normal:
        """Return the normal equations of residuals and Jacobians of all motions at a point."""
        size = len(self.parameters)
        eye = float(point.z @ point.z) + sum(float(start @ start) for start in point.starts)
        normal = Normal(eye, 0.0, point.z.copy(), np.zeros((size, size)), [], [], [], list(linearised), [])
        if self.robust:
            every = np.concatenate([found.residual for found in linearised])
            self._typical = max(1.0, float(np.median(np.abs(every))) / 0.6745)
        for found, start, change in zip(linearised, point.starts, self._change, strict=True):
            weight = self._weight(found.residual)
            square = gram(weight[:, None] * found.jacobian, found.jacobian)
            slope = np.einsum("mi,m->i", found.jacobian, weight * found.residual)
            normal.weights.append(weight)
            change[:] = np.clip(CHANGE / np.sqrt(1.0 + np.diag(square)), DIFFERENCE, LARGEST_CHANGE)
            normal.data_cost += float(np.sum(self._loss(found.residual)))
            normal.matrix += square[:size, :size]
            normal.gradient += slope[:size]
            normal.mixed.append(square[:size, size:])
            normal.start_matrices.append(square[size:, size:] + np.eye(len(start)))
            normal.start_gradients.append(slope[size:] + start)
        for residual, slope in self.known(point.z):
            normal.matrix += np.outer(slope, slope)
            normal.gradient += slope * residual
            normal.cost += residual**2
        normal.cost += normal.data_cost
        return normal

    def secant(self, normal: Normal, old: Point, trial: Trial) -> Normal:
        """Return the normal equations where a step led, with Jacobians that explain what residuals did (Broyden).

        Unknowns count by their curvature.
        """
        linearised, new = [], trial.point
        parts = zip(normal.linearised, trial.residuals, old.starts, new.starts, normal.start_matrices, strict=True)
        for found, residual, before, after, own in parts:
            move = np.concatenate([new.z - old.z, after - before])
            along = np.concatenate([np.diag(normal.matrix) + 1.0, np.diag(own)]) * move
            along /= max(float(move @ along), 1.0e-300)
            surprise = residual - found.residual - np.einsum("mi,i->m", found.jacobian, move)
            linearised.append(Linearised(residual, found.jacobian + surprise[:, None] * along))
        return self.assemble(new, linearised)

    @staticmethod
    def known_at(residuals: Sequence[np.ndarray], known: Sequence[Linearised]) -> list[Linearised]:
        """Return residuals (m,) of each motion with the Jacobians of another point, or of another physics step."""
        return [Linearised(residual, old.jacobian) for residual, old in zip(residuals, known, strict=True)]

    def residuals(self, point: Point) -> list[np.ndarray]:
        """Return the residuals (m,) of each motion."""
        starts = [start[None] for start in point.starts]
        return [found[:, 0] for found in self._costs(point.z[None], starts)[1]]

    def _weight(self, residual: np.ndarray) -> np.ndarray:
        """Return the weights of residuals."""
        return 1.0 / (1.0 + (residual / (ROBUST * self._typical)) ** 2) if self.robust else np.ones_like(residual)

    def _loss(self, residual: np.ndarray) -> np.ndarray:
        """Return what residuals cost: their squares, or less if they stand out."""
        if not self.robust:
            return residual**2
        limit = ROBUST * self._typical
        return limit**2 * np.log1p((residual / limit) ** 2)

    def known(self, z: np.ndarray) -> list[tuple[float, np.ndarray]]:
        """Return residual and slope (P,) of each piece of knowledge."""
        step = 1.0e-6
        robots = self.parameters.robots(np.concatenate([z[None], z + step * np.eye(len(z))]), self.replay.description)
        found = []
        for piece in self.knowledge:
            residual = (piece.measure(robots) - piece.value) / piece.deviation
            found.append((float(residual[0]), (residual[1:] - residual[0]) / step))
        return found

    def costs(self, z: np.ndarray, starts: Sequence[np.ndarray]) -> np.ndarray:
        """Return the cost of K points, (K, P) and (K, I) of each motion; infinite where a world broke."""
        return self._costs(z, starts)[0]

    def _costs(self, z: np.ndarray, starts: Sequence[np.ndarray]) -> tuple[np.ndarray, list[np.ndarray]]:
        """Return the cost of K points, and the residuals of each motion, (m, K)."""
        cost = np.sum(z**2, axis=1) + sum(np.sum(start**2, axis=1) for start in starts)
        robots, residuals = self.parameters.robots(z, self.replay.description), []
        for piece in self.knowledge:
            cost += ((piece.measure(robots) - piece.value) / piece.deviation) ** 2
        for motion, start in zip(self.motions, starts, strict=True):
            found = motion.residuals(self.replay, z, start)
            with np.errstate(over="ignore", invalid="ignore"):
                cost += np.sum(self._loss(found), axis=0)
            residuals.append(found)
        return np.where(np.isfinite(cost), cost, math.inf), residuals

    def step(self, point: Point, normal: Normal, bend: bool = True) -> Trial:
        """Return the best of the points that the dampings lead to.

        Each step is tried as it is and, if wanted, bent along the curvature of the residuals (geodesic acceleration).
        The point stays, with an infinite damping, if none is better.
        """
        free = self._free(point.z, normal.gradient)
        moves = [normal.solve(damping, free, normal.gradient, normal.start_gradients) for damping in DAMPINGS]
        move, starts = moves[0]
        promise = -float(normal.gradient[free] @ move[free])
        promise -= sum(float(g @ s) for g, s in zip(normal.start_gradients, starts, strict=True))
        if bend:
            moves = moves + self._bent(point, normal, free, moves)
        z = np.clip(point.z + np.array([move for move, _ in moves]), self._low, self._high)
        starts = [start + np.array([move[i] for _, move in moves]) for i, start in enumerate(point.starts)]
        trial = self._best(z, starts, promise)
        if not trial.cost < normal.cost:
            return Trial(point, normal.cost, math.inf, promise, [found.residual for found in normal.linearised])
        return trial

    def _free(self, z: np.ndarray, gradient: np.ndarray) -> np.ndarray:
        """Return the indices of the parameters that no bound stops."""
        return np.flatnonzero(~((z <= self._low) & (gradient > 0.0) | (z >= self._high) & (gradient < 0.0)))

    def _best(self, z: np.ndarray, starts: list[np.ndarray], promise: float) -> Trial:
        """Return the best of K points."""
        costs, residuals = self._costs(z, starts)
        best = int(np.argmin(costs))
        moved = Point(z[best], [start[best] for start in starts])
        damping = float(DAMPINGS[best % len(DAMPINGS)])
        return Trial(moved, float(costs[best]), damping, promise, [found[:, best] for found in residuals])

    def _bent(
        self, point: Point, normal: Normal, free: np.ndarray, plain: list[tuple[np.ndarray, list[np.ndarray]]]
    ) -> list[tuple[np.ndarray, list[np.ndarray]]]:
        """Return the steps that follow the curvature of the residuals, which many worlds a part of the way measure.

        Steps that would bend more than they go are left out.
        """
        size = len(point.z)
        ahead = np.clip(point.z + PROBE * np.array([move for move, _ in plain]), self._low, self._high)
        gradient, of_starts = np.zeros((size, len(plain))), []
        for i, (motion, linear, weight) in enumerate(zip(self.motions, normal.linearised, normal.weights, strict=True)):
            move = np.array([start[i] for _, start in plain])
            found = motion.residuals(self.replay, ahead, point.starts[i] + PROBE * move)
            both = np.concatenate([ahead - point.z, PROBE * move], axis=1)
            with np.errstate(invalid="ignore", over="ignore"):
                straight = np.einsum("mi,ki->mk", linear.jacobian, both)
                curvature = (found - linear.residual[:, None] - straight) / PROBE**2
                slope = gram(linear.jacobian, weight[:, None] * curvature)
            gradient += slope[:size]
            of_starts.append(slope[size:])
        bent = []
        for k, (move, starts) in enumerate(plain):
            slopes = [slope[:, k] for slope in of_starts]
            if np.isfinite(gradient[:, k]).all() and all(np.isfinite(slope).all() for slope in slopes):
                more, more_starts = normal.solve(DAMPINGS[k], free, gradient[:, k], slopes)
                if np.linalg.norm(more) < np.linalg.norm(move):
                    move, starts = move + more, [a + b for a, b in zip(starts, more_starts, strict=True)]
            bent.append((move, starts))
        return bent
