"""Motions that tell much of the robot, within limits and scored by the information that they give."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from jumper_warp.identification.motions import DEGREES, Motion, NoiseLevels
from jumper_warp.identification.parameters import ParameterSet
from jumper_warp.identification.recording import KINDS, Kind, Plan, measured, plot_plan, replay_plan, simulate_plan
from jumper_warp.identification.replay import Record, Replay
from jumper_warp.identification.residuals import MotionResiduals
from jumper_warp.robot.motors import FilterCfg, walking_filter
from jumper_warp.robot.values import RobotValues
from jumper_warp.sim.simulation import SolverName
from jumper_warp.utils.errors import InputError

SHARPEST = 25.0
"""[rad/s] Fastest joint of a safe motion: two thirds of the slowest motor's no-load speed."""
STEEPEST = 20.0
"""[deg] Most that the base may lean."""
HIGHEST = 0.65
"""[m] Highest base of a small jump."""
MARGIN = 5.0
"""[deg] Between a safe motion and the limits of its angles."""


def unsafe(plan: Plan, record: Record, limits: FilterCfg | None = None) -> str:
    """Return why a record of a plan is not safe; nothing if it is."""
    limits = walking_filter() if limits is None else limits
    angle, rate = record.angle[..., 0] / DEGREES, np.abs(record.rate[..., 0]).max()
    legs = angle.reshape(-1, 4, 3)
    checks = (
        ("lateral angle", legs[..., 0], limits.lateral),
        ("transversal angle", legs[..., 1:], limits.transversal),
        ("sum of transversal angles", legs[..., 1] + legs[..., 2], limits.sum),
    )
    if not record.valid[0]:
        return "the simulation breaks"
    for name, values, limit in checks:
        if values.min() < limit.lower + MARGIN or values.max() > limit.upper - MARGIN:
            return f"the {name} comes within {MARGIN:g} deg of its limits"
    if rate > SHARPEST:
        return f"a joint moves at {rate:.1f} rad/s"
    if plan.base == "free":
        x, y, _, _ = np.moveaxis(record.quaternion[..., 0], 1, 0)
        lean = np.degrees(np.arccos(np.clip(1.0 - 2.0 * (x**2 + y**2), -1.0, 1.0))).max()
        if lean > STEEPEST:
            return f"the base leans by {lean:.0f} deg"
        if record.position[:, 2].max() > HIGHEST:
            return f"the base rises to {record.position[:, 2].max():.2f} m"
        if record.position[:, 2].min() < 0.15:
            return "the base comes close to the ground"
    return ""


class Scorer:
    """Tells what motions would say of parameters, by the described robot."""

    def __init__(self, parameters: ParameterSet, noise: NoiseLevels | None = None, replay: Replay | None = None):
        """Prepare; replay: worlds to be used, whose description counts."""
        self.parameters, self.noise = parameters, noise or NoiseLevels()
        self.replay = replay or Replay()
        self._nominal = parameters.robots(np.zeros((1, len(parameters))))

    def record(self, plan: Plan) -> Record:
        """Return what the described robot does, from rest in the pose of the first targets."""
        return replay_plan(self.replay, plan, self._nominal)

    def information(self, plan: Plan, record: Record) -> np.ndarray:
        """Return what a motion says of the parameters, its start unknown: (P, P), in prior deviations."""
        motion = measured(plan, plan.kind, record, self._nominal, None, base_every=1)
        problem = MotionResiduals(motion, self.parameters, self.noise, self.replay.description)
        size = len(self.parameters)
        found = problem.linearise(self.replay, np.zeros(size), np.zeros(problem.start_size), 1.0e-3)
        square = found.jacobian.T @ found.jacobian
        own = square[size:, size:] + np.eye(problem.start_size)
        return square[:size, :size] - square[:size, size:] @ np.linalg.solve(own, square[size:, :size])


@dataclass(frozen=True, eq=False)
class Excitation:
    """Chosen motions and what they are expected to tell."""

    plans: tuple[Plan, ...]
    gain: tuple[float, ...]
    """[nat] Information about the parameters after each motion."""
    deviations: np.ndarray
    """(P,) Expected standard deviations after all, in prior deviations."""
    refused: tuple[str, ...]
    """Why candidates were left out."""
    parameters: ParameterSet

    def to_json(self) -> dict[str, Any]:
        """Return everything but the motions, as JSON can hold it."""
        expected = {
            p.name: {"unit": p.unit, "expected_deviation": p.deviation(0.0, float(d)), "of_prior": float(d)}
            for p, d in zip(self.parameters, self.deviations, strict=True)
        }
        return {"gain_nat": list(self.gain), "refused": list(self.refused), "parameters": expected}


def choose(
    scorer: Scorer, kinds: Sequence[Kind] = KINDS, *, candidates: int = 4, seconds: float = 1.25, seed: int = 0
) -> Excitation:
    """Return one safe motion of each kind, in turn the one of several candidates that tells most besides the others.

    Raises InputError: no candidate of a kind is safe.
    """
    rng, size = np.random.default_rng(seed), len(scorer.parameters)
    known, plans, gains, refused = np.eye(size), [], [], []
    for kind in kinds:
        best: tuple[float, Plan | None, np.ndarray] = (-math.inf, None, known)
        for _ in range(candidates):
            plan = plot_plan(kind, rng, seconds)
            record = scorer.record(plan)
            reason = unsafe(plan, record)
            if reason:
                refused.append(f"{kind}: {reason}")
                continue
            after = known + scorer.information(plan, record)
            gain = 0.5 * float(np.linalg.slogdet(after)[1])
            if gain > best[0]:
                best = (gain, plan, after)
        if best[1] is None:
            raise InputError(f"none of {candidates} candidates is safe; the last of them: {refused[-1]}")
        known = best[2]
        plans.append(best[1])
        gains.append(best[0])
    deviations = np.sqrt(np.diag(np.linalg.inv(known)))
    return Excitation(tuple(plans), tuple(gains), deviations, tuple(refused), scorer.parameters)


def record(
    chosen: Excitation,
    folder: Path,
    *,
    robots: RobotValues,
    noise: NoiseLevels,
    solver: SolverName = "jumper",
    rng: np.random.Generator | None = None,
    torque: bool = False,
) -> list[Motion]:
    """Carry chosen motions out by a simulated robot, and write them as npz files, whose names say their kinds.

    noise, rng, torque: as of `measured`. Raises OSError.
    """
    motions = []
    for i, plan in enumerate(chosen.plans):
        name = f"{i}_{plan.kind.replace(' ', '_')}"
        motions.append(
            measured(plan, name, simulate_plan(plan, solver=solver, robots=robots), robots, rng, noise, torque=torque)
        )
        motions[-1].save(folder / f"{name}.npz")
    return motions
