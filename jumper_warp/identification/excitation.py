"""Choice of safe, informative motions for identification: the best of random candidates by Fisher information."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from jumper_warp.identification.motions import DEGREES, NoiseLevels, RecordedMotion
from jumper_warp.identification.parameters import ParameterSet
from jumper_warp.identification.recording import KINDS, Kind, Plan, measure, replay_plan, sample_plan
from jumper_warp.identification.replay import MotionReplay, Record
from jumper_warp.identification.residuals import MotionResiduals
from jumper_warp.robot.description import RobotDescription, leg_dimensions, load_description
from jumper_warp.robot.folder import LOCKED
from jumper_warp.robot.measures import filter_for
from jumper_warp.robot.motors import walking_filter
from jumper_warp.robot.values import TRANSVERSAL, RobotValues
from jumper_warp.utils.errors import InputError
from jumper_warp.utils.progress import phase

MAX_JOINT_SPEED = 0.625  # [1] largest in a safe motion, over the slowest motor's no-load speed
MAX_TILT = 20.0  # [deg] largest tilt of the base in a safe motion
MIN_HEIGHT, MAX_HEIGHT = 0.15, 0.65  # [m] range of the Jumper's free base above the ground in a safe motion
MARGIN = 5.0  # [deg] between the angles of a safe motion and the filter's limits


def size_of(robot: RobotDescription) -> float:
    """Return the length of a robot's thigh relative to the Jumper's [1], to scale heights and torques."""
    return leg_dimensions(robot, "FL").thigh / leg_dimensions(load_description(), "FL").thigh


def plan_for(robot: RobotDescription, kind: Kind, rng: np.random.Generator, seconds: float) -> Plan:
    """Sample a plan for a robot: the Jumper's targets, moved with the stops; torque limit by weight and size.

    The jump of a smaller robot ends earlier: impacts after its landing would make many local minima. Without lateral
    axes both sides move alike on the ground, as a roll would drag the paws aside.
    """
    jumper = load_description()
    size = size_of(robot)
    plan = sample_plan(kind, rng, seconds, 12.0 * size * robot.mass / jumper.mass)
    share = min(1.0, math.sqrt(size)) if kind == "small jump" else 1.0
    target = plan.target[: math.ceil(share * len(plan.target))].copy()
    target[:, TRANSVERSAL] += 0.5 * (robot.transversal_sum[0] - jumper.transversal_sum[0])
    if plan.base == "free" and robot.motors[0] == LOCKED:
        target[:, [3, 4, 5, 9, 10, 11]] = target[:, [0, 1, 2, 6, 7, 8]]
    return replace(plan, target=target)


def unsafe_reason(plan: Plan, record: Record, robot: RobotDescription) -> str:
    """Return the reason why a simulated identification motion is unsafe, or an empty string if it is safe.

    plan: its motor targets; record: motion of one world. Limits of motor angles are the walking filter's.
    """
    limits = filter_for(walking_filter(), robot)
    size = size_of(robot)
    driven = [motor for motor in robot.motors if motor != LOCKED]
    angle = record.angle[..., 0] / DEGREES
    rate = np.abs(record.rate[..., 0]).max()
    legs = angle.reshape(-1, 4, 3)
    checks = (
        ("lateral angle", legs[..., 0], limits.lateral),
        ("transversal angle", legs[..., 1:], limits.transversal),
        ("sum of transversal angles", legs[..., 1] + legs[..., 2], limits.sum),
    )
    if not record.valid[0]:
        return "the simulation diverges"
    for name, values, limit in checks[robot.motors[0] == LOCKED :]:
        if values.min() < limit.lower + MARGIN or values.max() > limit.upper - MARGIN:
            return f"the {name} comes within {MARGIN:g} deg of its limits"
    if rate > MAX_JOINT_SPEED * min(motor.no_load_speed for motor in driven):
        return f"a joint moves at {rate:.1f} rad/s"
    if plan.base == "free":
        x, y, _, _ = np.moveaxis(record.quaternion[..., 0], 1, 0)
        tilt = np.degrees(np.arccos(np.clip(1.0 - 2.0 * (x**2 + y**2), -1.0, 1.0))).max()
        if tilt > MAX_TILT:
            return f"the base leans by {tilt:.0f} deg"
        if record.position[:, 2].max() > size * MAX_HEIGHT:
            return f"the base rises to {record.position[:, 2].max():.2f} m"
        if record.position[:, 2].min() < size * MIN_HEIGHT:
            return "the base comes close to the ground"
    return ""


@dataclass(eq=False)
class Scorer:
    """Scorer of candidate motions, by the Fisher information of their simulated recordings about the parameters."""

    parameters: ParameterSet
    noise: NoiseLevels = field(default_factory=NoiseLevels)
    replay: MotionReplay = field(default_factory=MotionReplay)
    torque: bool = False  # Whether the recordings have motor torques

    def __post_init__(self) -> None:
        """Prepare the robot as described."""
        self._nominal = self.parameters.robots(np.zeros((1, len(self.parameters))), self.replay.description)

    def record(self, plan: Plan) -> Record:
        """Simulate the nominal robot under the motor targets of a plan, and return its motion.

        One world, from rest in the pose of the first targets.
        """
        return replay_plan(self.replay, plan, self._nominal)

    def information(self, plan: Plan, record: Record) -> np.ndarray:
        """Return the Fisher information (P, P) of a motion about the normalised parameters.

        The initial state is marginalised: what the motion reveals about both at once does not count. Information is the
        inverse of the covariance that a fit to this motion alone would have; it adds up over motions.
        """
        motion = measure(plan, plan.kind, record, self._nominal, None, torque=self.torque)
        problem = MotionResiduals(motion, self.parameters, self.noise, self.replay.description)
        size = len(self.parameters)
        linear = problem.linearise(self.replay, np.zeros(size), np.zeros(problem.start_size), 1.0e-3)
        square = linear.jacobian.T @ linear.jacobian
        start_matrix = square[size:, size:] + np.eye(problem.start_size)
        return square[:size, :size] - square[:size, size:] @ np.linalg.solve(start_matrix, square[size:, :size])


@dataclass(frozen=True, eq=False)
class Excitation:
    """Motions chosen for an identification, and their expected information about the parameters."""

    plans: tuple[Plan, ...]  # motions, in the order in which they were chosen
    gain: tuple[float, ...]  # [nat] Total information gained over the prior, 1/2 ln det, after each motion
    std: np.ndarray  # (P,) Expected standard deviations after all motions, relative to the prior's
    refused: tuple[str, ...]  # `kind: reason` of each unsafe candidate
    parameters: ParameterSet

    def to_json(self) -> dict[str, Any]:
        """Return the content of `excite.json` but the robot's mass: information gain, refused motions, parameters."""
        expected = {
            p.name: {"unit": p.unit, "expected_deviation": p.std(0.0, float(d)), "of_prior": float(d)}
            for p, d in zip(self.parameters, self.std, strict=True)
        }
        return {"gain_nat": list(self.gain), "refused": list(self.refused), "parameters": expected}


def choose(
    scorer: Scorer, kinds: Sequence[Kind] = KINDS, *, candidates: int = 4, seconds: float = 1.25, seed: int = 0
) -> Excitation:
    """Choose the most informative safe motion of several random candidates for each entry of `kinds`.

    A candidate's score is the information of all motions chosen earlier and of itself, as 1/2 ln det: a candidate that
    repeats what is known scores low. candidates: number tried by motion; seconds [s]: duration of a motion. Raises
    InputError: no candidate of a kind is safe.
    """
    rng = np.random.default_rng(seed)
    information = np.eye(len(scorer.parameters))
    plans = []
    gains = []
    refused = []
    robot = scorer.replay.description
    with phase("planning motions", len(kinds) * candidates) as advance:
        for kind in kinds:
            best: tuple[float, Plan | None, np.ndarray] = (-math.inf, None, information)
            for _ in range(candidates):
                plan = plan_for(robot, kind, rng, seconds)
                record = scorer.record(plan)
                if reason := unsafe_reason(plan, record, robot):
                    refused.append(f"{kind}: {reason}")
                else:
                    after = information + scorer.information(plan, record)
                    gain = 0.5 * float(np.linalg.slogdet(after)[1])
                    best = (gain, plan, after) if gain > best[0] else best
                advance()
            if best[1] is None:
                raise InputError(f"none of {candidates} candidates is safe; reason for the last one: {refused[-1]}")
            information = best[2]
            plans.append(best[1])
            gains.append(best[0])
    std = np.sqrt(np.diag(np.linalg.inv(information)))
    return Excitation(tuple(plans), tuple(gains), std, tuple(refused), scorer.parameters)


def record_motions(
    chosen: Excitation,
    folder: Path,
    replay: MotionReplay,
    *,
    robots: RobotValues,
    noise: NoiseLevels,
    rng: np.random.Generator | None = None,
    torque: bool = False,
) -> list[RecordedMotion]:
    """Record chosen motions on a simulated robot, and write each to `folder` as `<number>_<kind>.npz`. Returns them.

    replay: of the robot's description; robots: values of the robot, N = 1. noise, rng, torque: see `measure`.
    Raises OSError.
    """
    motions = []
    with phase("recording motions", len(chosen.plans)) as advance:
        for i, plan in enumerate(chosen.plans):
            name = f"{i}_{plan.kind.replace(' ', '_')}"
            motions.append(measure(plan, name, replay_plan(replay, plan, robots), robots, rng, noise, torque=torque))
            motions[-1].save(folder / f"{name}.npz")
            advance()
    return motions
