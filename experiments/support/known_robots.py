"""Robots whose parameters are known: drawn from the priors, recorded as they move, identified, and compared."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from jumper_warp.identification.excitation import unsafe
from jumper_warp.identification.findings import Identification
from jumper_warp.identification.identify import identify, total_mass, weighed
from jumper_warp.identification.least_squares import Knowledge
from jumper_warp.identification.motions import Motion
from jumper_warp.identification.parameters import ParameterSet
from jumper_warp.identification.recording import KINDS, Plan, draw_plan, measured, replay_plan
from jumper_warp.identification.replay import Record, Replay
from jumper_warp.robot.values import RobotValues

SPREAD, MOST = 0.7, 1.5
"""Of the drawn robots, in deviations of the priors."""
HELD_OUT_TORQUE = 16.0
"""[N m]"""
SCALE = 0.02
"""[kg] Deviation of the scale."""


@dataclass
class Case:
    """A known robot, its recorded motions, and a held-out jump."""

    truth: np.ndarray
    """(P,) normalised."""
    robots: RobotValues
    motions: list[Motion]
    mass: Knowledge
    held_out: Plan
    record: Record
    """Of the held-out jump."""


Carry = Callable[[Plan, RobotValues], Record]


def make_case(parameters: ParameterSet, seed: int, carry: Carry, replay: Replay) -> Case:
    """Return a robot and what it did; carry: carries a plan out."""
    rng = np.random.default_rng(seed)
    z = np.clip(SPREAD * rng.normal(size=len(parameters)), -MOST, MOST)
    late = parameters.names.index("latency")
    z[late] = 0.2 + abs(z[late])
    robots = parameters.robots(z)
    nominal = parameters.robots(np.zeros((1, len(z))))
    plans: list[Plan] = []
    while len(plans) < len(KINDS):
        plan = draw_plan(KINDS[len(plans)], rng)
        if not unsafe(plan, replay_plan(replay, plan, nominal)):
            plans.append(plan)
    motions = [measured(p, f"{i} {p.kind}", carry(p, robots), robots, rng) for i, p in enumerate(plans)]
    held_out = draw_plan("small jump", rng, torque_limit=HELD_OUT_TORQUE)
    mass = weighed(float(total_mass(robots)[0] + SCALE * rng.normal()), SCALE)
    return Case(z, robots, motions, mass, held_out, carry(held_out, robots))


def prediction_errors(case: Case, robots: RobotValues, carry: Carry) -> tuple[float, float]:
    """Return rms errors of angles [deg] and height [mm] of the held-out jump as some robot predicts it."""
    found = carry(case.held_out, robots)
    angle = found.angle[..., 0] + robots.offset[:1] - case.record.angle[..., 0] - case.robots.offset[:1]
    height = found.position[:, 2, 0] - case.record.position[:, 2, 0]
    return float(np.degrees(np.sqrt(np.mean(angle**2)))), 1000.0 * float(np.sqrt(np.mean(height**2)))


def accuracy(parameters: ParameterSet, case: Case, found: Identification) -> dict[str, float]:
    """Return the errors of what was found, the worst of each kind."""
    values, true = found.values, parameters.values(case.truth)

    def worst(quantity: str, relative: bool) -> float:
        chosen = [i for i, p in enumerate(parameters) if p.quantity == quantity]
        error = np.abs(values[chosen] - true[chosen])
        return float((error / np.abs(true[chosen]) if relative else error).max())

    error = np.abs(found.z - case.truth) / np.maximum(found.deviations, 1.0e-9)
    return {
        "kp_worst_percent": 100.0 * worst("kp", True),
        "kd_worst_percent": 100.0 * worst("kd", True),
        "base_mass_percent": 100.0 * worst("base_mass", True),
        "offset_worst_deg": float(np.degrees(worst("offset", False))),
        "armature_worst_percent": 100.0 * worst("armature", True),
        "latency_us": 1.0e6 * worst("latency", False),
        "coverage": float(np.mean(error[found.identified] < 1.96)),
        "error_over_deviation_rms": float(np.sqrt(np.mean(error[found.identified] ** 2))),
        "mismatch": found.mismatch,
    }


def run_case(
    parameters: ParameterSet, case: Case, replay: Replay, ours: Carry, dt: float | None = None
) -> tuple[dict[str, float], Identification]:
    """Identify one robot and return its figures; ours: carries a plan out as the model does."""
    found = identify(case.motions, parameters, knowledge=[case.mass], replay=replay, dt=dt)
    before = prediction_errors(case, parameters.robots(np.zeros((1, len(parameters)))), ours)
    after = prediction_errors(case, found.robots(), ours)
    figures = accuracy(parameters, case, found) | {
        "chi2": found.chi2,
        "nominal_chi2": found.nominal_chi2,
        "identified": float(found.identified.sum()),
        "wall_s": found.seconds,
        "cpu_s": found.cpu_seconds,
        "million_world_steps": found.world_steps / 1.0e6,
        "held_out_nominal_deg": before[0],
        "held_out_deg": after[0],
        "held_out_ratio": before[0] / after[0],
        "held_out_nominal_mm": before[1],
        "held_out_mm": after[1],
        "held_out_height_ratio": before[1] / after[1],
    }
    return figures, found
