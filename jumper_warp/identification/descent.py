"""The way from the described robot to the minimum: motions one after another, and few Jacobians."""

from __future__ import annotations

import itertools
import time
from collections.abc import Sequence

import numpy as np

from jumper_warp.identification.findings import Step
from jumper_warp.identification.least_squares import Knowledge, LeastSquares, Linearised, Normal, Point, Trial
from jumper_warp.identification.motions import Motion, NoiseLevels
from jumper_warp.identification.parameters import ParameterSet
from jumper_warp.identification.replay import Replay
from jumper_warp.identification.residuals import MotionResiduals, NothingMeasured
from jumper_warp.robot.description import RobotDescription

PIECE = 0.25
"""[s] Length of the pieces that motions without a held base are first cut into."""
WORTH_A_STEP = 0.02
"""Relative decrease of the cost below which the steps of all stages but the last end."""
CONVERGED = 0.5
"""Decrease of the cost, in mean squared residuals, below which the optimisation ends: 1 is what one deviation costs."""
AS_PROMISED = 0.3
"""Share of the promised decrease with which a step is good enough for another one with the same Jacobian."""
HORIZONS = (0.4, 0.7, 1.0)
"""Shares of a motion on the ground that are taken one after another: what a paw's stroke does depends on all before."""
ATTEMPTS = 2
STUCK = 20.0
"""Decrease of the cost that the last steps promise but do not bring where kinks of contact hold them: the motions are
then taken one after another again, from there."""
MOST_STEPS = 40
"""In one stage."""


class Descent:
    """An optimisation: the steps that it took, and what they cost."""

    def __init__(self, replay: Replay):
        """Start the clocks."""
        self.replay, self.steps, self.stage = replay, [], 0
        self.promised = 0.0
        """Decrease of the cost that the last steps promised when they ended, but did not bring."""
        self._begun = (time.perf_counter(), time.process_time(), replay.world_steps)

    def steps_per_mode(self) -> tuple[float, float, int]:
        """Return wall time [s], CPU time [s] and physics steps of all worlds."""
        seconds, cpu, steps = self._begun
        return time.perf_counter() - seconds, time.process_time() - cpu, self.replay.world_steps - steps

    def note(self, problem: LeastSquares, trial: Trial) -> None:
        """Record a step."""
        seconds, _, count = self.steps_per_mode()
        self.steps.append(Step(self.stage, trial.cost / problem.count, trial.damping, count, seconds))

    def steps_down(
        self, problem: LeastSquares, point: Point, normal: Normal, worth: float | None = None
    ) -> tuple[Point, Normal]:
        """Take steps until one gains less than a share `worth` of the cost; None: until a new Jacobian gains nothing.

        A Jacobian serves for as many steps as go nearly as it promises; each corrects it by what it saw (Broyden).
        """
        fresh, self.stage = worth is not None, self.stage + 1
        for _ in range(MOST_STEPS):
            least = max((worth or 0.0) * normal.cost, CONVERGED * max(1.0, normal.data_cost / problem.count))
            trial = problem.step(point, normal, bend=fresh)
            self.note(problem, trial)
            gain = normal.cost - trial.cost
            self.promised = trial.promise - gain
            if gain < least and (fresh or (worth is not None and trial.promise < least)):
                return trial.point, problem.assemble(trial.point, problem.known_at(trial.residuals, normal.linearised))
            fresh = gain < max(least, AS_PROMISED * trial.promise)
            normal = problem.normal(trial.point) if fresh else problem.secant(normal, point, trial)
            point = trial.point
        return point, normal


def descend(
    descent: Descent,
    parameters: ParameterSet,
    motions: Sequence[Sequence[MotionResiduals]],
    pieces: Sequence[MotionResiduals],
    knowledge: Sequence[Knowledge],
) -> tuple[LeastSquares, Point, Normal]:
    """Return the minimum, and the normal equations there.

    Motions with a held base come first: their legs do not feel each other. The others follow, next the one that is
    explained best by then; residuals that stand out count less (a paw that strikes 1 ms late is all wrong for a
    moment). At last all residuals count fully.

    motions: all, as the first stages and as the last ones take them: the physics steps may differ. pieces: motions in
    short pieces for a first stage, or none. Raises InputError: the model cannot follow a motion.
    """
    replay, (rough, whole) = descent.replay, motions
    z = np.zeros(len(parameters))
    if pieces:
        problem = LeastSquares(parameters, pieces, replay, knowledge, robust=True)
        begin = problem.expected()
        z = descent.steps_down(problem, begin, problem.normal(begin), worth=0.1)[0].z
    found = []
    for _ in range(ATTEMPTS):
        point, linearised = one_after_another(descent, parameters, rough, knowledge, z)
        final = LeastSquares(parameters, whole, replay, knowledge)
        if whole is not rough:
            linearised = final.known_at(final.residuals(point), linearised)
        point, normal = descent.steps_down(final, point, final.assemble(point, linearised))
        found.append((final, point, normal))
        if descent.promised < STUCK * max(1.0, normal.data_cost / final.count):
            break
        z = point.z
    return min(found, key=lambda end: end[2].cost)


def one_after_another(
    descent: Descent,
    parameters: ParameterSet,
    motions: Sequence[MotionResiduals],
    knowledge: Sequence[Knowledge],
    z: np.ndarray,
) -> tuple[Point, list[Linearised]]:
    """Return where all motions together lead, taken one after another from parameters z, and their Jacobians there."""
    point, taken, linearised = Point(z, []), [], []
    while len(taken) < len(motions):
        left = [i for i in range(len(motions)) if i not in taken]
        held = [i for i in left if not motions[i].free]
        new = held or [min(left, key=lambda i: misfit(motions[i], descent.replay, point.z))]
        point = Point(point.z, point.starts + [np.zeros(motions[i].start_size) for i in new])
        for part in (1.0,) if held else HORIZONS:
            begun = [motions[i] for i in taken] + [motions[i].until(part) for i in new]
            problem = LeastSquares(parameters, begun, descent.replay, knowledge, robust=True)
            normal = problem.normal(point, linearised[: len(taken)])
            point, normal = descent.steps_down(problem, point, normal, WORTH_A_STEP)
            linearised = normal.linearised
        taken += new
    order = np.argsort(taken)
    return Point(point.z, [point.starts[i] for i in order]), [linearised[i] for i in order]


def misfit(motion: MotionResiduals, replay: Replay, z: np.ndarray) -> float:
    """Return the mean of ln(1 + r^2) of a motion's residuals from its expected start."""
    found = motion.residuals(replay, z[None], np.zeros((1, motion.start_size)))
    with np.errstate(over="ignore"):
        return float(np.mean(np.log1p(np.nan_to_num(found, posinf=1.0e100) ** 2)))


def pieces_of(
    motion: Motion, parameters: ParameterSet, noise: NoiseLevels, description: RobotDescription, dt: float | None
) -> list[MotionResiduals]:
    """Return a motion in pieces of about `PIECE`, those without measurements left out."""
    rows = len(motion.time)
    number = max(1, min(round(motion.duration / PIECE), rows // 4))
    edges = [round(rows * i / number) for i in range(number + 1)]
    found = []
    for span in itertools.pairwise(edges):
        try:
            found.append(MotionResiduals(motion, parameters, noise, description, dt, span))
        except NothingMeasured:
            continue
    return found
