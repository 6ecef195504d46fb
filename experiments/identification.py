"""Identification of known robots: by this project, at a finer step, on SolverMuJoCo, and by other methods.

    python experiments/identification.py --seeds 20 --out outputs/identification

Each robot is drawn from the priors and does two hung chirps, a standing chirp and a small jump of 1.25 s, measured with
noise (0.05 deg, 1 deg/s at 240 Hz; 5 mm, 0.5 deg at 120 Hz) and weighed (20 g). Starts are unknown. A jump at 16 N m
instead of 12 is held out: its angles and height are predicted from the targets alone.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import tyro
from rich.console import Console
from rich.table import Table
from scipy.optimize import least_squares

from jumper_warp.cli.main import run_command
from jumper_warp.evaluation.heights import reached
from jumper_warp.evaluation.jumps import Jumps
from jumper_warp.evaluation.log import run_evaluation, termination_names
from jumper_warp.evaluation.plots import drawn
from jumper_warp.optim.evolution import identify_by_evolution
from jumper_warp.optim.excitation import unsafe
from jumper_warp.optim.findings import Identification
from jumper_warp.optim.identification import identify, total_mass, weighed
from jumper_warp.optim.least_squares import Knowledge, LeastSquares, Point
from jumper_warp.optim.motions import Motion
from jumper_warp.optim.parameters import ParameterSet, jumper_parameters
from jumper_warp.optim.plans import KINDS, Plan, draw_plan
from jumper_warp.optim.recording import measured, replay_plan, simulate_plan
from jumper_warp.optim.replay import Record, Replay
from jumper_warp.optim.residuals import MotionResiduals, NoiseLevels
from jumper_warp.policies.restore import Conditions, env_of_policy, open_policy
from jumper_warp.robot.overlay import overlay_of
from jumper_warp.robot.values import RobotValues
from jumper_warp.utils.errors import InputError
from jumper_warp.utils.output import output_dir, write_figures
from jumper_warp.utils.runtime import announce

SPREAD, MOST = 0.7, 1.5
"""Of the drawn robots, in deviations of the priors."""
HELD_OUT_TORQUE = 16.0
"""[N m]"""
REFINE = 16
"""Steps of the finer truth in a step of the model."""
SCALE = 0.02
"""[kg] Deviation of the scale."""
PARTS = ("same", "fine", "rough", "mujoco", "methods", "policy")
Part = Literal["same", "fine", "rough", "mujoco", "methods", "policy"]


@dataclass(frozen=True)
class Args:
    """Flags."""

    seeds: int = 20
    """Robots that are identified on the simulator that recorded them."""
    parts: tuple[Part, ...] = PARTS
    """What is run."""
    fine_dt: float = 1.0 / 3840.0
    """[s] Physics step of the model that identifies the robot recorded at a sixteenth of 1/480 s; "rough": 1/480."""
    policy: str = "vertical_jump"
    """Policy whose jumps the identified robot is to predict."""
    jumps: int = 64
    """Number of these."""
    out: Path | None = None
    """Folder for figures and plots (default: outputs/identification/<time>)."""
    threads: int | None = None
    """CPU threads (default: all cores)."""

    def __post_init__(self) -> None:
        """Check the values."""
        if self.seeds < 1 or self.jumps < 3:
            raise InputError(f"need at least 1 seed and 3 jumps, got {self.seeds}, {self.jumps}")


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


def scipy_fit(parameters: ParameterSet, case: Case, replay: Replay, seconds: float) -> Point:
    """Return where SciPy's trust region comes in so many seconds, by differences over the same parallel worlds."""
    whole = [MotionResiduals(motion, parameters, NoiseLevels(), replay.description) for motion in case.motions]
    problem = LeastSquares(parameters, whole, replay, [case.mass])
    point, size, ends = problem.expected(), len(parameters), time.perf_counter() + seconds
    edges = np.cumsum([size, *(len(start) for start in point.starts)])

    class OutOfTime(Exception):
        pass

    best = (np.inf, point)

    def split(x: np.ndarray) -> list[np.ndarray]:
        return np.split(x, edges[:-1])

    def residuals(x: np.ndarray) -> np.ndarray:
        nonlocal best
        z, *starts = split(x)
        rows = [m.residuals(replay, z[None], s[None])[:, 0] for m, s in zip(whole, starts, strict=True)]
        mass = (case.mass.measure(parameters.robots(z)) - case.mass.value) / case.mass.deviation
        found = np.concatenate([*rows, mass, x])
        cost = float(found @ found)
        if cost < best[0]:
            best = (cost, Point(z.copy(), [start.copy() for start in starts]))
        if time.perf_counter() > ends:
            raise OutOfTime
        return np.nan_to_num(found, posinf=1.0e6)

    def jacobian(x: np.ndarray) -> np.ndarray:
        z, *starts = split(x)
        table = np.zeros((problem.count + 1 + len(x), len(x)))
        row = 0
        for i, (motion, start) in enumerate(zip(whole, starts, strict=True)):
            found = motion.linearise(replay, z, start).jacobian
            table[row : row + len(found), :size] = found[:, :size]
            table[row : row + len(found), edges[i] : edges[i + 1]] = found[:, size:]
            row += len(found)
        slopes = problem.known(z)
        table[row, :size] = slopes[0][1]
        table[row + 1 :] = np.eye(len(x))
        return table

    low, high = parameters.bounds()
    wide = np.full(edges[-1] - size, np.inf)
    limits = (np.concatenate([low, -wide]), np.concatenate([high, wide]))
    begin = np.concatenate([point.z, *point.starts])
    begin[:size] += 0.2 * (begin[:size] <= low)  # its trust region shrinks at bounds
    try:
        least_squares(residuals, begin, jacobian, limits)
    except OutOfTime:
        pass
    return best[1]


def compare_methods(parameters: ParameterSet, case: Case, replay: Replay, ours: Carry, seconds: float) -> dict:
    """Return χ² and held-out errors of CMA-ES and SciPy in the time that this project took."""
    evolved = identify_by_evolution(case.motions, parameters, knowledge=[case.mass], max_seconds=seconds)
    trusted = scipy_fit(parameters, case, replay, seconds)
    figures = {}
    for name, point in (("cma", Point(evolved.z, list(evolved.starts))), ("scipy", trusted)):
        robots = parameters.robots(point.z[None])
        angle, height = prediction_errors(case, robots, ours)
        figures |= {f"{name}_held_out_deg": angle, f"{name}_held_out_mm": height}
        figures[f"{name}_chi2"] = chi2_at(parameters, case, replay, point)
    return figures | {"methods_wall_s": seconds, "cma_million_world_steps": evolved.world_steps / 1.0e6}


def chi2_at(parameters: ParameterSet, case: Case, replay: Replay, point: Point) -> float:
    """Return the mean squared weighed residual at a point."""
    whole = [MotionResiduals(motion, parameters, NoiseLevels(), replay.description) for motion in case.motions]
    problem = LeastSquares(parameters, whole, replay)
    return sum(float(found @ found) for found in problem.residuals(point)) / problem.count


def policy_errors(args: Args, case: Case, found: Identification, folder: Path) -> dict[str, float]:
    """Return how well the described and the identified robot predict a policy's jumps on the true one."""
    quantities = tuple(dict.fromkeys(parameter.quantity for parameter in found.parameters))
    overlay_of(case.robots, quantities, source="truth").save(folder / "truth.json")
    found.overlay("identified").save(folder / "identified.json")
    apexes = {}
    for name, robot in (("true", "truth.json"), ("identified", "identified.json"), ("described", None)):
        policy = open_policy(args.policy)
        conditions = Conditions(device="cpu", robot=None if robot is None else folder / robot)
        env = env_of_policy(policy, args.jumps, conditions)
        policy.to(env.device)
        log = Jumps(np.linspace(0.5, 1.0, args.jumps), termination_names(env.task))
        run_evaluation(policy.act, env, log)
        apexes[name] = (log.apex.copy(), log.target, reached(log))
    true, target, _ = apexes["true"]
    figures = {"policy_error_on_true_m": float(np.mean(np.abs(true - target)))}
    for name in ("described", "identified"):
        figures[f"policy_apex_error_{name}_m"] = float(np.mean(np.abs(apexes[name][0] - true)))
        figures[f"policy_success_{name}"] = float(np.mean(apexes[name][2]))
    return figures | {"policy_success_true": float(np.mean(apexes["true"][2]))}


def main(args: Args) -> dict[str, Any]:
    """Run the experiment and return its figures."""
    announce("cpu", args.threads)
    folder = output_dir("identification", args.out)
    parameters = jumper_parameters()
    replay = Replay(len(parameters) + 37, device="cpu", threads=args.threads)
    replay_one = Replay(1, device="cpu", threads=1)

    def ours(plan: Plan, robots: RobotValues) -> Record:
        return replay_plan(replay_one, plan, robots)

    def finely(plan: Plan, robots: RobotValues) -> Record:
        return replay_plan(replay_one, plan, robots, REFINE)

    def as_fine_model(plan: Plan, robots: RobotValues) -> Record:
        return replay_plan(replay_one, plan, robots, max(1, round(1.0 / 480.0 / args.fine_dt)))

    def by_mujoco(plan: Plan, robots: RobotValues) -> Record:
        return simulate_plan(plan, solver="mujoco", robots=robots)

    values: dict[str, Any] = {"parameters": len(parameters), "seconds_of_data": 1.25 * len(KINDS)}
    rows, last = [], None
    for seed in range(args.seeds if {"same", "methods", "policy"} & set(args.parts) else 0):
        case = make_case(parameters, seed, ours, replay)
        figures, found = run_case(parameters, case, replay, ours)
        rows.append(figures)
        last = last or (case, found)
        told = ("chi2", "wall_s", "cpu_s", "million_world_steps", "coverage", "held_out_ratio")
        print(f"seed {seed}:", ", ".join(f"{name} {figures[name]:.3g}" for name in told), flush=True)
    if rows:
        values |= {name: float(np.median([row[name] for row in rows])) for name in rows[0]}
        values["coverage"] = float(np.mean([row["coverage"] for row in rows]))
        values |= {f"{name}_of_seeds": [row[name] for row in rows] for name in ("chi2", "wall_s", "cpu_s", "coverage")}
    for part, carry, model, dt in (
        ("fine", finely, as_fine_model, args.fine_dt),
        ("rough", finely, ours, None),
        ("mujoco", by_mujoco, ours, None),
    ):
        if part in args.parts:
            case = make_case(parameters, 100, carry, replay)
            figures, found = run_case(parameters, case, replay, model, dt)
            values |= {f"{part}_{name}": value for name, value in figures.items()}
            print(part, {name: round(value, 4) for name, value in figures.items()}, flush=True)
    if "methods" in args.parts and last:
        values |= compare_methods(parameters, last[0], replay, ours, last[1].seconds)
    if "policy" in args.parts and last:
        values |= policy_errors(args, *last, folder)
    write_figures(folder, values)
    plot(rows, folder / "identification.png")
    table = Table("figure", "value", title="Identification of known robots")
    for name, value in values.items():
        table.add_row(name, str([round(x, 3) for x in value]) if isinstance(value, list) else f"{value:.4g}")
    Console().print(table)
    print(f"figures and plot in {folder}")
    return values


def plot(rows: list[dict[str, float]], path: Path) -> None:
    """Draw χ², coverage, held-out errors and time of all seeds."""
    if not rows:
        return
    with drawn(path, 1, 4, figsize=(14, 3.2)) as axes:
        seeds = np.arange(len(rows))
        axes[0].plot(seeds, [row["chi2"] for row in rows], "o")
        axes[0].axhline(1.02, color="0.6", linestyle="--")
        axes[0].set(xlabel="seed", ylabel="χ² per value")
        axes[1].plot(seeds, [100.0 * row["coverage"] for row in rows], "o")
        axes[1].axhline(100.0 * float(np.mean([row["coverage"] for row in rows])), color="C0", lw=1, label="mean")
        axes[1].axhspan(90.0, 98.0, color="0.92")
        axes[1].set(xlabel="seed", ylabel="within 95 % interval [%]")
        axes[1].legend()
        for name, label in (("held_out_nominal_deg", "described"), ("held_out_deg", "identified")):
            axes[2].semilogy(seeds, [row[name] for row in rows], "o", label=label)
        axes[2].set(xlabel="seed", ylabel="held-out angle error [deg]")
        for name, label in (("wall_s", "wall"), ("cpu_s", "CPU")):
            axes[3].plot(seeds, [row[name] for row in rows], "o", label=label)
        axes[3].axhline(10.0, color="0.6", linestyle="--")
        axes[3].set(xlabel="seed", ylabel="time [s]", ylim=(0.0, None))
        axes[2].legend()
        axes[3].legend()


if __name__ == "__main__":
    run_command(lambda: main(tyro.cli(Args)))
