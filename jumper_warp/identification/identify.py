"""Identification of the robot's parameters from recorded motions (paper, Section V-F a).

Unknowns are the parameters and where each motion starts. Residuals are weighed by noise, priors and further knowledge
count like measurements, and the sum of squares is minimised by Levenberg-Marquardt over parallel worlds, in stages:
the motions are first cut into short pieces with starts of their own, whose residuals are nearly linear in the
parameters, and then taken as wholes.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import warp as wp

from jumper_warp.identification.descent import Descent, descend, pieces_of
from jumper_warp.identification.findings import Fit, Identification, Step
from jumper_warp.identification.least_squares import Knowledge, LeastSquares, Normal, Point
from jumper_warp.identification.motions import Motion, NoiseLevels
from jumper_warp.identification.parameters import ParameterSet
from jumper_warp.identification.replay import Replay
from jumper_warp.identification.residuals import MotionResiduals
from jumper_warp.identification.uncertainty import mismatch_factor, systematic_deviations, weak_directions
from jumper_warp.robot.description import RobotDescription, load_description
from jumper_warp.robot.values import LINK_KINDS, RobotValues
from jumper_warp.utils.checks import check_positive
from jumper_warp.utils.errors import InputError

COARSE = 1.0 / 480.0
"""[s] Physics step of all stages but the last ones, where a finer one is asked for."""
POPULATION = 128
"""Of the evolution strategy."""
FIRST_DEVIATION = 0.3
"""Of its search, in deviations of the priors."""


def total_mass(robots: RobotValues) -> np.ndarray:
    """Return the mass [kg] of N robots, (N,)."""
    leg = [load_description().link(f"FL_{kind}").mass for kind in LINK_KINDS]
    return robots.base_mass[:, 0] + 4.0 * robots.link_mass @ np.array(leg)


def weighed(mass: float, deviation: float = 0.02) -> Knowledge:
    """Return what a scale says [kg].

    Raises InputError: a deviation that is not positive, or a mass that is not within 0.5 to 2 times the described one.
    """
    described = float(total_mass(RobotValues.nominal(1))[0])
    if not 0.5 * described <= mass <= 2.0 * described:
        raise InputError(
            f"weighed mass must be in {0.5 * described:.4g} to {2.0 * described:.4g} kg (the robot is described with "
            f"{described:.4g} kg), got {mass:.6g} kg"
        )
    check_positive("deviation of the weighed mass", deviation)
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

    knowledge: of the robot besides the motions. dt: largest physics step [s], by default 1/480. replay: worlds of an
    earlier call, to be used again; its description counts. threads: of a CPU. Raises InputError: no motions, motions
    with gaps, without measurements or that the model cannot follow.
    """
    if not motions:
        raise InputError("there must be at least one motion")
    noise = NoiseLevels() if noise is None else noise
    if replay is None:
        replay = Replay(description=description, device=device, threads=threads)
    descent = Descent(replay)
    robot, rough_dt = replay.description, None if dt is None else max(dt, COARSE)
    whole = [MotionResiduals(motion, parameters, noise, robot, dt) for motion in motions]
    rough = whole if rough_dt == dt else [MotionResiduals(m, parameters, noise, robot, rough_dt) for m in motions]
    pieces = []
    if all(motion.free for motion in whole):
        pieces = [piece for motion in motions for piece in pieces_of(motion, parameters, noise, robot, rough_dt)]
    problem, point, normal = descend(descent, parameters, (rough, whole), pieces, knowledge)
    return result(problem, point, normal, descent)


def identify_by_evolution(
    motions: Sequence[Motion],
    parameters: ParameterSet,
    *,
    noise: NoiseLevels | None = None,
    knowledge: Sequence[Knowledge] = (),
    dt: float | None = None,
    max_seconds: float = 60.0,
    population: int = POPULATION,
    seed: int = 0,
    device: wp.DeviceLike = None,
    threads: int | None = None,
) -> Identification:
    """Return what CMA-ES finds in `max_seconds`, motions starting as their first rows say; see `identify`.

    Raises InputError: as `identify`, or `cma` is not installed.
    """
    try:
        import cma
    except ImportError:
        raise InputError("CMA-ES needs the package cma, which is not installed: pip install cma") from None
    if not motions or not max_seconds > 0.0 or population < 4:
        raise InputError("evolution needs motions, a time above 0 s and a population of at least 4")
    replay = Replay(device=device, threads=threads)
    whole = [MotionResiduals(motion, parameters, noise or NoiseLevels(), replay.description, dt) for motion in motions]
    problem = LeastSquares(parameters, whole, replay, knowledge)
    point, descent = problem.expected(), Descent(replay)
    low, high = parameters.bounds()
    options = {"popsize": population, "seed": seed + 1, "verbose": -9, "bounds": [low, high]}
    search = cma.CMAEvolutionStrategy(point.z, FIRST_DEVIATION, options)
    starts = [np.repeat(start[None], population, axis=0) for start in point.starts]
    best, cost = point.z, np.inf
    while descent.steps_per_mode()[0] < max_seconds and not search.stop():
        candidates = np.array(search.ask())
        costs = problem.costs(candidates, starts)
        search.tell(list(candidates), list(np.where(np.isfinite(costs), costs, 1.0e12)))
        if costs.min() < cost:
            best, cost = candidates[int(np.argmin(costs))], float(costs.min())
        seconds, _, count = descent.steps_per_mode()
        descent.steps.append(Step(0, cost / problem.count, 0.0, count, seconds))
    point = Point(np.clip(best, low, high), point.starts)
    return result(problem, point, problem.normal(point), descent)


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


def result(problem: LeastSquares, point: Point, normal: Normal, descent: Descent) -> Identification:
    """Return what is reported of an optimisation that ended at a point, with the normal equations there."""
    nominal, fits = (channel_fits(problem, at) for at in (problem.expected(), point))
    rows = [
        Fit(motion, channel, cost / count, old / count, rms)
        for (motion, channel, cost, count, rms), (_, _, old, _, _) in zip(fits, nominal, strict=True)
    ]
    information = normal.information()
    tables = []
    for motion, residual in zip(problem.motions, problem.residuals(point), strict=True):
        table = np.full(motion.valid.shape, math.nan)
        table[motion.valid] = residual
        tables.append(table)
    covariance = np.linalg.inv(information + np.eye(len(information)))
    mismatch = mismatch_factor(tables)
    columns = [np.nonzero(motion.valid)[1] for motion in problem.motions]
    systematic = systematic_deviations(normal, columns, covariance) if mismatch > 1.0 else np.zeros(len(point.z))
    seconds, cpu_seconds, world_steps = descent.steps_per_mode()
    return Identification(
        parameters=problem.parameters,
        z=point.z,
        covariance=covariance,
        mismatch=mismatch,
        systematic=systematic,
        chi2=sum(cost for _, _, cost, _, _ in fits) / problem.count,
        nominal_chi2=sum(cost for _, _, cost, _, _ in nominal) / problem.count,
        count=problem.count,
        fits=tuple(rows),
        directions=weak_directions(problem.parameters, information),
        steps=tuple(descent.steps),
        dt=max(motion.dt for motion in problem.motions),
        seconds=seconds,
        cpu_seconds=cpu_seconds,
        world_steps=world_steps,
        knowledge=tuple(problem.knowledge),
        motions=tuple(problem.motions),
        starts=tuple(point.starts),
    )
