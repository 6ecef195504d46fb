"""Identification of the robot's parameters from recorded motions (paper, Section V-F a).

Unknowns are the parameters and the initial state of each motion. Residuals are divided by the noise; priors and prior
measurements count like measurements. The sum of squares is minimised by Levenberg-Marquardt over parallel worlds, in
stages: motions are first cut into short pieces, each with its own initial state, whose residuals are nearly linear in
the parameters; then whole motions are fitted. The cost has local minima, as contacts begin, slip and end: the minimum
is confirmed by a second start, and the residuals are tested (`consistency`).
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence

import numpy as np
import warp as wp

from jumper_warp.identification import results
from jumper_warp.identification.consistency import contradictions, residual_tests, without
from jumper_warp.identification.least_squares import (
    FRICTION,
    FRICTION_MOVES,
    LeastSquares,
    NormalEquations,
    Point,
    Trial,
    replace_residuals,
)
from jumper_warp.identification.motions import NoiseLevels, RecordedMotion, check_distinct
from jumper_warp.identification.parameters import ParameterSet, PriorMeasurement
from jumper_warp.identification.replay import MotionReplay
from jumper_warp.identification.residuals import Linearised, MotionResiduals, pieces_of
from jumper_warp.robot.description import RobotDescription
from jumper_warp.utils.checks import check_type
from jumper_warp.utils.progress import phase

COARSE_DT = 1.0 / 480.0  # [s] lower bound of the physics step in all stages but the last one
PIECES_DECREASE, STAGE_DECREASE = 0.1, 0.02
"""[1] Relative decrease of the cost below which the stage on pieces, and the stages on whole motions, end."""
CONVERGED = 0.5
"""Decrease of the cost, in mean squared residuals, below which the last stage ends; 1 is one standard deviation."""
GOOD_STEP = 0.3  # Actual over predicted decrease of the cost above which a step is good enough to reuse the Jacobian
HORIZONS = (0.4, 0.7, 1.0)
"""Fractions of a motion on the ground that are fitted in turn, as a paw's motion depends on all earlier contacts."""
MAX_STARTS = 4  # largest number of starts; two are enough if they agree and all tests pass, or if residuals fail
DISPLACEMENT, LARGEST_DISPLACEMENT = 3.0, 0.1
"""Standard deviation of the displacement of a start from an earlier minimum, in standard deviations of the estimate.
Largest displacement of a parameter, in standard deviations of its prior."""
MAX_STEPS = 40  # largest number of Levenberg-Marquardt steps in a stage


def identify(
    motions: Sequence[RecordedMotion],
    parameters: ParameterSet,
    *,
    noise: NoiseLevels | None = None,
    prior_measurements: Sequence[PriorMeasurement] = (),
    dt: float | None = None,
    description: RobotDescription | None = None,
    replay: MotionReplay | None = None,
    device: wp.DeviceLike = None,
    threads: int | None = None,
) -> results.Identification:
    """Identify the robot's parameters from recorded motions by least squares (Levenberg-Marquardt).

    prior_measurements: such as a weighed mass. dt [s]: largest physics step, by default 1/480. replay: simulation to
    reuse from an earlier call; it overrides description, device and threads (of the CPU). Raises InputError: no
    motions, the same motion twice, motions with gaps, without measurements or in which the simulation diverges, or
    motions that identify no parameter.
    """
    check_distinct(motions)
    check_type("parameters", parameters, ParameterSet)
    check_type("noise", noise, NoiseLevels | None)
    check_type("dt", dt, float | None)
    noise = NoiseLevels() if noise is None else noise
    if replay is None:
        replay = MotionReplay(description=description, device=device, threads=threads)
    robot = replay.description
    coarse_dt = None if dt is None else max(dt, COARSE_DT)
    whole = [MotionResiduals(motion, parameters, noise, robot, dt) for motion in motions]
    coarse = whole if coarse_dt == dt else [MotionResiduals(m, parameters, noise, robot, coarse_dt) for m in motions]
    pieces = []
    if all(motion.free for motion in whole):
        pieces = [piece for motion in motions for piece in pieces_of(motion, parameters, noise, robot, coarse_dt)]
    num_free = sum(motion.free for motion in whole)
    stages = bool(pieces) + (num_free < len(whole)) + len(HORIZONS) * num_free + 1
    with phase("identifying parameters", stages) as advance:
        descent = Descent(replay, advance)
        problem, minima = descend(descent, parameters, coarse, whole, pieces, prior_measurements)
    return results.summarise(problem, minima, descent.steps, descent.effort)


class Descent:
    """Levenberg-Marquardt optimisation of a robot's parameters, with a log of steps and of computing time."""

    def __init__(self, replay: MotionReplay, advance: Callable[[], object] = lambda: None):
        """Start the clocks and an empty log of the optimisation at stage 0.

        replay: simulation whose physics steps are counted; advance: called after every stage.
        """
        self.replay = replay
        self.steps = []
        self.stage = 0
        self.advance = advance
        self._begin = (time.perf_counter(), time.process_time(), replay.world_steps)

    def effort(self) -> results.Effort:
        """Return wall time, CPU time and physics steps that the optimisation has taken so far."""
        seconds, cpu, steps = self._begin
        return results.Effort(time.perf_counter() - seconds, time.process_time() - cpu, self.replay.world_steps - steps)

    def record_step(self, problem: LeastSquares, trial: Trial) -> None:
        """Append the result of a Levenberg-Marquardt step to the log `steps`."""
        chi2 = trial.cost / problem.count
        effort = self.effort()
        self.steps.append(results.DescentStep(self.stage, chi2, trial.damping, effort.world_steps, effort.seconds))

    def minimise(
        self, problem: LeastSquares, point: Point, normal: NormalEquations, decrease: float | None = None
    ) -> tuple[Point, NormalEquations]:
        """Minimise a least-squares problem by Levenberg-Marquardt steps, which form one stage of the log.

        Returned: the point after the stage, and the normal equations there. decrease: the stage ends at the first step
        that lowers the cost by less than this fraction; None: at the first step with a new Jacobian that lowers it by
        less than `CONVERGED`. While steps are `GOOD_STEP`, Broyden's update replaces a new Jacobian.
        """
        new_jacobian = decrease is not None
        self.stage = self.stage + 1
        for _ in range(MAX_STEPS):
            least = max((decrease or 0.0) * normal.cost, CONVERGED * problem.scale(normal))
            trial = problem.step(point, normal, geodesic=new_jacobian)
            self.record_step(problem, trial)
            gain = normal.cost - trial.cost
            predicted = trial.predicted_decrease
            if gain < least and (new_jacobian or (decrease is not None and predicted < least)):
                residuals = replace_residuals(normal.linearised, trial.residuals)
                point = trial.point
                normal = problem.assemble(trial.point, residuals)
                break
            new_jacobian = gain < max(least, GOOD_STEP * predicted)
            normal = problem.normal(trial.point) if new_jacobian else problem.broyden_update(normal, point, trial)
            point = trial.point
        self.advance()
        return point, normal

    def refine(self, problem: LeastSquares, point: Point, normal: NormalEquations) -> results.Minimum:
        """Find the local minimum near a point; if another paw friction lowers the cost, find the minimum from there.

        normal: the normal equations at the point.
        """
        point, normal = self.minimise(problem, point, normal)
        names = problem.parameters.names
        if FRICTION in names:
            moved, costs = problem.scan(point, normal, names.index(FRICTION), FRICTION_MOVES)
            best = int(np.argmin(costs))
            if costs[best] < normal.cost - CONVERGED * problem.scale(normal):
                point, normal = self.minimise(problem, moved[best], problem.normal(moved[best]))
        return results.Minimum(point, normal)


def descend(
    descent: Descent,
    parameters: ParameterSet,
    coarse: Sequence[MotionResiduals],
    whole: Sequence[MotionResiduals],
    pieces: Sequence[MotionResiduals],
    prior_measurements: Sequence[PriorMeasurement],
) -> tuple[LeastSquares, list[results.Minimum]]:
    """Fit parameters and initial states to all motions by Levenberg-Marquardt from two to four starting points.

    Returned: the least-squares problem of all motions and the minimum of each start, best first. Derivatives of the
    best exclude jumps of the residuals. The first start begins at the described robot and adds the motions one after
    another. If a sensor contradicts the others, the next one begins with all motions, at the parameters that the best
    minimum so far would have without this sensor; else it adds the motions again, from a random displacement. Such a
    start often ends in the same wrong minimum as the first. So a minimum found without a sensor is confirmed by a start
    that is displaced and has all motions; so does the last one. Starts end if two agree and no sensor contradicts the
    others, or if the residuals of two fail.

    coarse, whole: all motions, with the physics steps of the first stages and of the last stage. pieces: short pieces
    of the motions for a first stage, empty to skip it. Raises InputError: the simulation diverges in a motion.
    """
    replay = descent.replay
    z = np.zeros(len(parameters))
    if pieces:
        problem = LeastSquares(parameters, pieces, replay, prior_measurements, robust=True)
        begin = problem.nominal_point()
        z = descent.minimise(problem, begin, problem.normal(begin), PIECES_DECREASE)[0].z
    final = LeastSquares(parameters, whole, replay, prior_measurements)
    minima = []
    rng = np.random.default_rng(0)
    left_out = set()
    initial = []
    direct = found_direct = False  # whether a start, and that of the best minimum, begins with all motions
    while len(minima) < MAX_STARTS:
        if minima:
            best, normal = minima[0]
            fits = all(test.passed for test in residual_tests(final, normal))
            failed = contradictions(final, normal)
            agree = results.starts_agree(results.excess_costs(final, minima))
            if (agree and not failed) or (len(minima) > 1 and not fits):
                break
            untried = [sensor for sensor in failed if (sensor.motion, sensor.name) not in left_out]
            direct = fits and (bool(untried) or found_direct or len(minima) == MAX_STARTS - 1)
            if fits and untried:
                left_out.add((untried[0].motion, untried[0].name))
                move = without(normal, untried[0])
            else:
                move = displacement(normal, rng)
            z = np.clip(best.z + move, *parameters.bounds())
            initial = normal.following(best.starts, z - best.z)
        if direct:
            point = Point(z, initial)
            linearised = final.normal(point).linearised
        else:
            point, linearised = add_motions(descent, parameters, coarse, prior_measurements, z)
            if whole is not coarse:
                linearised = replace_residuals(linearised, final.residuals(point))
        point, normal = descent.refine(final, point, final.assemble(point, linearised))
        if not minima or normal.cost < minima[0].normal.cost:
            found_direct = direct
            normal = final.without_jumps(point, normal)
        minima.append(results.Minimum(point, normal))
        minima.sort(key=lambda minimum: minimum.normal.cost)
    return final, minima


def displacement(normal: NormalEquations, rng: np.random.Generator) -> np.ndarray:
    """Return a random change (P,) of the parameters, from a minimum to a new starting point.

    It is `DISPLACEMENT` standard deviations of the estimate, correlated like its errors, so that it moves far where the
    data say little. normal: normal equations at the minimum.
    """
    covariance = np.linalg.inv(normal.information() + np.eye(len(normal.gradient)))
    move = DISPLACEMENT * np.linalg.cholesky(covariance) @ rng.normal(size=len(covariance))
    return np.clip(move, -LARGEST_DISPLACEMENT, LARGEST_DISPLACEMENT)


def add_motions(
    descent: Descent,
    parameters: ParameterSet,
    motions: Sequence[MotionResiduals],
    prior_measurements: Sequence[PriorMeasurement],
    z: np.ndarray,
) -> tuple[Point, list[Linearised]]:
    """Fit the parameters to a growing set of motions with a robust cost, adding motions one by one.

    Returned: the minimum over all motions and the Jacobians there. z: parameters to start from, (P,), normalised.
    Motions with a held base come first, as their legs do not interact; then always the motion with the least misfit.
    The robust cost limits outliers, such as a paw that strikes 1 ms late.
    """
    point = Point(z, [])
    added = []
    linearised = []
    while len(added) < len(motions):
        remaining = [i for i in range(len(motions)) if i not in added]
        held = [i for i in remaining if not motions[i].free]
        new = held or [min(remaining, key=lambda i: misfit(motions[i], descent.replay, point.z))]
        point = Point(point.z, point.starts + [np.zeros(motions[i].start_size) for i in new])
        for fraction in (1.0,) if held else HORIZONS:
            fitted = [motions[i] for i in added] + [motions[i].first_part(fraction) for i in new]
            problem = LeastSquares(parameters, fitted, descent.replay, prior_measurements, robust=True)
            normal = problem.normal(point, linearised[: len(added)])
            point, normal = descent.minimise(problem, point, normal, STAGE_DECREASE)
            linearised = normal.linearised
        added += new
    order = np.argsort(added)
    return Point(point.z, [point.starts[i] for i in order]), [linearised[i] for i in order]


def misfit(motion: MotionResiduals, replay: MotionReplay, z: np.ndarray) -> float:
    """Return how badly a motion fits parameters z (P,) at the nominal initial state: mean ln(1 + residual^2).

    The logarithm limits the effect of a few large residuals, as of a motion that diverges late.
    """
    residuals = motion.residuals(replay, z[None], np.zeros((1, motion.start_size)))
    with np.errstate(over="ignore"):
        return float(np.mean(np.log1p(np.nan_to_num(residuals, posinf=1.0e100) ** 2)))
