"""Identification of the robot's parameters from recorded motions (paper, Section V-F a).

Unknowns are the parameters and where each motion starts. Residuals are weighed by noise, priors and further knowledge
count like measurements, and the sum of squares is minimised by Levenberg-Marquardt over parallel worlds, in stages:
the motions are first cut into short pieces with starts of their own, whose residuals are nearly linear in the
parameters, and then taken as wholes.
"""

from __future__ import annotations

import functools
import itertools
import math
import time
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
import warp as wp

from jumper_warp.optim.findings import Fit, Identification, Step
from jumper_warp.optim.least_squares import Knowledge, LeastSquares, Normal, Point
from jumper_warp.optim.motions import Motion
from jumper_warp.optim.parameters import ParameterSet
from jumper_warp.optim.replay import Replay
from jumper_warp.optim.residuals import MotionResiduals, NoiseLevels, NothingMeasured
from jumper_warp.optim.uncertainty import mismatch_factor, systematic_deviations, weak_directions
from jumper_warp.robot.description import RobotDescription, load_description
from jumper_warp.robot.values import LINK_KINDS, RobotValues
from jumper_warp.utils.checks import check_positive
from jumper_warp.utils.errors import InputError

PIECES = (0.25,)
"""[s] Lengths of the pieces of the stages before the last."""
WORTH_A_STEP = 0.1
"""Relative decrease of the cost below which the steps on pieces end."""
CONVERGED = 1.0
"""Decrease of the cost, in mean squared residuals, below which the optimisation ends: 1 is what one deviation costs."""
COARSE = 1.0 / 480.0
"""[s] Physics step of all stages but the last ones, where a finer one is asked for."""
MOST_STEPS = (5, 25)
"""On pieces, and in each stage of whole motions."""


class End(NamedTuple):
    """Where steps ended."""

    cost: float
    point: Point
    normal: Normal
    """Close to it, before the last step."""


def total_mass(robots: RobotValues, description: RobotDescription | None = None) -> np.ndarray:
    """Return the mass [kg] of N robots, (N,)."""
    robot = load_description() if description is None else description
    leg = np.array([robot.link(f"FL_{kind}").mass for kind in LINK_KINDS])
    return robots.base_mass[:, 0] + 4.0 * robots.link_mass @ leg


def weighed(mass: float, deviation: float = 0.02) -> Knowledge:
    """Return what a scale says [kg]. Raises InputError for a mass or deviation that is not positive."""
    check_positive("weighed mass and its deviation", mass, deviation)
    return Knowledge("total mass", total_mass, mass, deviation)


def identify(
    motions: Sequence[Motion],
    parameters: ParameterSet,
    *,
    noise: NoiseLevels | None = None,
    knowledge: Sequence[Knowledge] = (),
    dt: float | None = None,
    description: RobotDescription | None = None,
    replay: Replay | None = None,
    device: wp.DeviceLike = None,
    threads: int | None = None,
) -> Identification:
    """Return the parameters that explain the motions best.

    Args:
        motions: What was recorded.
        parameters: What is unknown.
        noise: Of the sensors.
        knowledge: Of the robot besides the motions.
        dt: Largest physics step [s], by default 1/480.
        description: Of the nominal robot, by default the project's.
        replay: Worlds of an earlier call, to be used again; its description counts.
        device: Warp device.
        threads: Of a CPU.

    Raises:
        InputError: no motions, motions with gaps, without measurements or that the model cannot follow.
    """
    if not motions:
        raise InputError("there must be at least one motion")
    started, cpu = time.perf_counter(), time.process_time()
    noise = NoiseLevels() if noise is None else noise
    if replay is None:
        replay = Replay(len(parameters) + 37, description=description, device=device, threads=threads)
    before, steps = replay.world_steps, []
    robot, rough_dt = replay.description, None if dt is None else max(dt, COARSE)

    def descend(problem: LeastSquares, point: Point, stage: int, least: Callable[[float, float], float]) -> End:
        """Take steps until one gains less than least(cost before, cost after)."""
        for _ in range(MOST_STEPS[0 if stage < len(PIECES) else 1]):
            normal = problem.normal(point)
            point, cost, damping = problem.step(point, normal)
            seconds, count = time.perf_counter() - started, replay.world_steps - before
            steps.append(Step(stage, cost / problem.count, damping, count, seconds))
            if normal.cost - cost < least(normal.cost, cost):
                break
        return End(cost, point, normal)

    whole = [MotionResiduals(motion, parameters, noise, robot, dt) for motion in motions]
    final = LeastSquares(parameters, whole, replay, knowledge)
    nominal = channel_fits(final, final.expected())
    z = np.zeros(len(parameters))
    for stage, length in enumerate(PIECES):
        pieces = [piece for each in motions for piece in pieces_of(each, parameters, noise, robot, rough_dt, length)]
        problem = LeastSquares(parameters, pieces, replay, knowledge, robust=True)
        end = descend(problem, Point(z, problem.expected().starts), stage, lambda old, _: WORTH_A_STEP * old)
        z = end.point.z
    rough = whole if rough_dt == dt else [MotionResiduals(m, parameters, noise, robot, rough_dt) for m in motions]
    problem = LeastSquares(parameters, rough, replay, knowledge, robust=True)
    stage = len(PIECES)
    nearly, enough = (functools.partial(gained, share=share / final.count) for share in (10.0, 1.0))
    end = descend(problem, Point(z, problem.expected().starts), stage, nearly)
    ends = [descend(final, end.point, stage + 1, enough)]
    # what friction at rest makes of a start is full of small minima: try again from outside
    again = Point(ends[0].point.z, final.expected().starts)
    ends.append(descend(final, again, stage + 2, enough))
    return result(final, ends, nominal, steps, (started, cpu, before))


def gained(_: float, cost: float, share: float) -> float:
    """Return the decrease that a step must bring, a share of the cost after it."""
    return CONVERGED * share * cost


def pieces_of(
    motion: Motion,
    parameters: ParameterSet,
    noise: NoiseLevels,
    description: RobotDescription,
    dt: float | None,
    length: float,
) -> list[MotionResiduals]:
    """Return a motion in pieces of about a length [s], those without measurements left out."""
    rows = len(motion.time)
    number = max(1, min(round(motion.duration / length), rows // 4))
    edges = [round(rows * i / number) for i in range(number + 1)]
    found = []
    for span in itertools.pairwise(edges):
        try:
            found.append(MotionResiduals(motion, parameters, noise, description, dt, span))
        except NothingMeasured:
            continue
    return found


def channel_fits(problem: LeastSquares, point: Point) -> list[tuple[str, str, float, int, float]]:
    """Return (motion, channel, sum of squares, count, root mean square in SI units) of all channels at a point."""
    found = []
    for motion, start in zip(problem.motions, point.starts, strict=True):
        table = np.full(motion.valid.shape, math.nan)
        table[motion.valid] = motion.residuals(problem.replay, point.z[None], start[None])[:, 0]
        for name, columns in motion.channels:
            values = table[:, columns][motion.valid[:, columns]]
            if len(values):
                rms = math.sqrt(float(np.mean(values**2))) * motion.sigma[columns][0]
                found.append((motion.motion.name, name, float(values @ values), len(values), rms))
    return found


def result(
    problem: LeastSquares, ends: Sequence[End], nominal: list, steps: list[Step], begun: tuple
) -> Identification:
    """Return what is reported of an optimisation; ends: of each try."""
    started, cpu, before = begun
    _, point, normal = min(ends, key=lambda end: end.cost)
    fits = channel_fits(problem, point)
    rows = [
        Fit(motion, channel, cost / count, old / count, rms)
        for (motion, channel, cost, count, rms), (_, _, old, _, _) in zip(fits, nominal, strict=True)
    ]
    information = normal.information()
    chi2 = sum(cost for _, _, cost, _, _ in fits) / problem.count
    tables = []
    for motion, start in zip(problem.motions, point.starts, strict=True):
        table = np.full(motion.valid.shape, math.nan)
        table[motion.valid] = motion.residuals(problem.replay, point.z[None], start[None])[:, 0]
        tables.append(table)
    covariance = np.linalg.inv(information + np.eye(len(information)))
    mismatch = mismatch_factor(tables)
    columns = [np.nonzero(motion.valid)[1] for motion in problem.motions]
    systematic = systematic_deviations(normal, columns, covariance) if mismatch > 1.0 else np.zeros(len(point.z))
    return Identification(
        parameters=problem.parameters,
        z=point.z,
        covariance=covariance,
        mismatch=mismatch,
        systematic=systematic,
        spread=np.ptp([end.point.z for end in ends], axis=0),
        chi2=chi2,
        nominal_chi2=sum(cost for _, _, cost, _, _ in nominal) / problem.count,
        count=problem.count,
        fits=tuple(rows),
        directions=weak_directions(problem.parameters, information),
        steps=tuple(steps),
        dt=max(motion.dt for motion in problem.motions),
        seconds=time.perf_counter() - started,
        cpu_seconds=time.process_time() - cpu,
        world_steps=problem.replay.world_steps - before,
        motions=tuple(problem.motions),
        starts=tuple(point.starts),
    )


__all__ = ["Identification", "identify", "total_mass", "weighed"]
