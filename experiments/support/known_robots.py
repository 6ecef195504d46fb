"""Robots with known parameters: sampled from the priors, recorded, identified, and compared with the truth."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from jumper_warp.identification.excitation import unsafe_reason
from jumper_warp.identification.identify import identify
from jumper_warp.identification.motions import RecordedMotion
from jumper_warp.identification.parameters import ParameterSet, PriorMeasurement, total_mass, weighed_mass
from jumper_warp.identification.recording import KINDS, Plan, measure, replay_plan, sample_plan
from jumper_warp.identification.replay import MotionReplay, Record
from jumper_warp.identification.report import identified_overlay
from jumper_warp.identification.results import Identification
from jumper_warp.policies.conditions import Conditions, env_of_recipe
from jumper_warp.policies.runs import open_policy
from jumper_warp.robot.overlay import overlay_of
from jumper_warp.robot.values import RobotValues
from jumper_warp.viz.plots import figure
from support.learning import run_jumps

SPREAD, MOST = 0.7, 1.5  # [1] Standard deviation and limit of sampled parameters, in standard deviations of priors
HELD_OUT_TORQUE = 16.0  # [N m] Torque limit of the held-out jump
SCALE_STD = 0.02  # [kg] Standard deviation of the weighed mass


@dataclass
class Case:
    """A simulated robot with known parameters, its recorded motions, and a held-out jump."""

    truth: np.ndarray  # (parameters,) True parameters, normalised by the priors
    robots: RobotValues  # The same parameters in their units, one robot
    motions: list[RecordedMotion]  # Measured motions, one for each of KINDS
    mass: PriorMeasurement  # Weighed mass
    held_out: Plan  # Targets of the held-out jump
    record: Record  # Measured trajectory of the held-out jump


Simulate = Callable[[Plan, RobotValues], Record]  # Returns the trajectory of a robot that executes a plan


def make_case(parameters: ParameterSet, seed: int, simulate: Simulate, replay: MotionReplay) -> Case:
    """Sample a random robot, and simulate the recording of its motions, its weighing and a held-out jump.

    simulate: replaces the real robot; replay: checks that the motions are safe.
    """
    rng = np.random.default_rng(seed)
    z = np.clip(SPREAD * rng.normal(size=len(parameters)), -MOST, MOST)
    late = parameters.names.index("latency")
    z[late] = 0.2 + abs(z[late])  # a latency is positive
    robots = parameters.robots(z)
    nominal = parameters.robots(np.zeros((1, len(z))))
    plans: list[Plan] = []
    while len(plans) < len(KINDS):
        plan = sample_plan(KINDS[len(plans)], rng)
        if not unsafe_reason(plan, replay_plan(replay, plan, nominal)):
            plans.append(plan)
    motions = [measure(p, f"{i} {p.kind}", simulate(p, robots), robots, rng) for i, p in enumerate(plans)]
    held_out = sample_plan("small jump", rng, torque_limit=HELD_OUT_TORQUE)
    mass = weighed_mass(float(total_mass(robots)[0] + SCALE_STD * rng.normal()), SCALE_STD)
    return Case(z, robots, motions, mass, held_out, simulate(held_out, robots))


def prediction_errors(case: Case, robots: RobotValues, simulate: Simulate) -> tuple[float, float]:
    """Return RMS errors of motor angles [deg] and base height [mm] of the held-out jump predicted by `robots`."""
    predicted = simulate(case.held_out, robots)
    angle = predicted.angle[..., 0] + robots.offset[:1] - case.record.angle[..., 0] - case.robots.offset[:1]
    height = predicted.position[:, 2, 0] - case.record.position[:, 2, 0]
    return float(np.degrees(np.sqrt(np.mean(angle**2)))), 1000.0 * float(np.sqrt(np.mean(height**2)))


def accuracy(parameters: ParameterSet, case: Case, result: Identification) -> dict[str, float]:
    """Compare identified and true parameters: return errors, coverage of 95 % intervals, and their widening (mismatch).

    result: identified from the case. Keys end with the unit; coverage, error_over_deviation_rms, mismatch are [1].
    """
    values, true = result.values, parameters.values(case.truth)

    def worst(quantity: str, relative: bool) -> float:
        """Return the largest absolute or relative error of the parameters of a quantity."""
        chosen = [i for i, p in enumerate(parameters) if p.quantity == quantity]
        error = np.abs(values[chosen] - true[chosen])
        return float((error / np.abs(true[chosen]) if relative else error).max())

    error = np.abs(result.z - case.truth) / np.maximum(result.std, 1.0e-9)
    return {
        "kp_worst_percent": 100.0 * worst("kp", True), "kd_worst_percent": 100.0 * worst("kd", True),
        "base_mass_percent": 100.0 * worst("base_mass", True),
        "offset_worst_deg": float(np.degrees(worst("offset", False))),
        "armature_worst_percent": 100.0 * worst("armature", True), "latency_us": 1.0e6 * worst("latency", False),
        "coverage": float(np.mean(error[result.identified] < 1.96)),
        "error_over_deviation_rms": float(np.sqrt(np.mean(error[result.identified] ** 2))), "mismatch": result.mismatch,
    }  # fmt: skip


def run_case(
    parameters: ParameterSet, case: Case, replay: MotionReplay, ours: Simulate, dt: float | None = None
) -> tuple[dict[str, float], Identification]:
    """Identify a robot with known parameters: return errors and computing time as metrics, and the result.

    replay: simulates the motions of the identification; ours: simulates a plan with the model, for the predictions;
    dt [s]: physics step of the model, None: the default.
    """
    result = identify(case.motions, parameters, prior_measurements=[case.mass], replay=replay, dt=dt)
    (nominal_deg, nominal_mm), (deg, mm) = (
        prediction_errors(case, robots, ours)
        for robots in (parameters.robots(np.zeros((1, len(parameters)))), result.robots())
    )
    metrics = accuracy(parameters, case, result) | {
        "chi2": result.chi2, "nominal_chi2": result.nominal_chi2, "identified": float(result.identified.sum()),
        "wall_s": result.effort.seconds, "cpu_s": result.effort.cpu_seconds,
        "million_world_steps": result.effort.world_steps / 1.0e6,
        "held_out_nominal_deg": nominal_deg, "held_out_deg": deg, "held_out_ratio": nominal_deg / deg,
        "held_out_nominal_mm": nominal_mm, "held_out_mm": mm, "held_out_height_ratio": nominal_mm / mm,
    }  # fmt: skip
    return metrics, result


def policy_errors(name: str, jumps: int, case: Case, result: Identification, folder: Path) -> dict[str, float]:
    """Return mean differences between a policy's apexes on the true robot and on the nominal or identified one [m].

    name: of the policy; jumps: number of them, to heights of 0.5 to 1.0 m; result: identified from the case. Robots
    are saved as overlays into `folder`. The result also has `policy_error_on_true_m`, the mean error of the apexes on
    the true robot, and `policy_success_<robot>`, the rate of reached heights.
    """
    quantities = tuple(dict.fromkeys(parameter.quantity for parameter in result.parameters))
    identified = identified_overlay(result, "identified")
    overlays = {"true": overlay_of(case.robots, quantities, source="truth"), "identified": identified}
    apex, success = {}, {}
    for robot in ("true", "identified", "described"):
        if robot in overlays:
            overlays[robot].save(folder / f"{robot}.json")
        policy = open_policy(name)
        conditions = Conditions(device="cpu", robot=folder / f"{robot}.json" if robot in overlays else None)
        env = env_of_recipe(policy.recipe(), jumps, conditions)
        policy.to(env.device)
        log = run_jumps(policy.act, env, np.linspace(0.5, 1.0, jumps))
        apex[robot], success[f"policy_success_{robot}"] = log.apex.copy(), float(np.mean(log.outcome.reached))
    errors = {
        f"policy_apex_error_{robot}_m": float(np.mean(np.abs(apex[robot] - apex["true"])))
        for robot in ("described", "identified")
    }
    return {"policy_error_on_true_m": float(np.mean(np.abs(apex["true"] - log.goals[..., 2])))} | errors | success


def plot_cases(rows: list[dict[str, float]], path: Path) -> None:
    """Plot χ², coverage, prediction errors and time of the identified robots over seeds.

    rows: metrics of `run_case`, one per seed.
    """
    panels = (
        ("χ² per value", {"": "chi2"}, {}),
        ("fraction within 95 % interval", {"": "coverage"}, {"ylim": (0.0, 1.0)}),
        ("held-out angle error [deg]", {"described": "held_out_nominal_deg", "identified": "held_out_deg"},
         {"yscale": "log"}),
        ("time [s]", {"wall time": "wall_s", "CPU time": "cpu_s"}, {"ylim": (0.0, None)}),
    )  # fmt: skip
    with figure(path, 1, len(panels), figsize=(15, 4.5), title="Identified robots") as axes:
        for axis, (title, series, settings) in zip(axes, panels, strict=True):
            for label, name in series.items():
                axis.plot([row[name] for row in rows], "o", label=label)
            axis.set(xlabel="seed", ylabel=title, **settings)
