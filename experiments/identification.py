"""Identification of known robots: by this project, at a finer step, on SolverMuJoCo, and by other methods.

    python experiments/identification.py --seeds 20 --out outputs/identification

Each robot is drawn from the priors and does two hung chirps, a standing chirp and a small jump of 1.25 s, measured with
noise (0.05 deg, 1 deg/s at 240 Hz; 5 mm, 0.5 deg at 120 Hz) and weighed (20 g). Starts are unknown. A jump at 16 N m
instead of 12 is held out: its angles and height are predicted from the targets alone.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import tyro
from rich.console import Console
from rich.table import Table

from jumper_warp.cli.main import run_command
from jumper_warp.evaluation.heights import run_jumps
from jumper_warp.evaluation.plots import drawn
from jumper_warp.identification.findings import Identification
from jumper_warp.identification.parameters import jumper_parameters
from jumper_warp.identification.recording import KINDS, Plan, replay_plan, simulate_plan
from jumper_warp.identification.replay import Record, Replay
from jumper_warp.policies.conditions import Conditions, env_of_policy
from jumper_warp.policies.runs import open_policy
from jumper_warp.robot.overlay import overlay_of
from jumper_warp.robot.values import RobotValues
from jumper_warp.utils.errors import InputError
from jumper_warp.utils.output import output_dir, write_metrics
from jumper_warp.utils.runtime import announce
from support.identification_methods import compare_methods
from support.known_robots import Case, make_case, run_case

REFINE = 16
"""Steps of the finer truth in a step of the model."""
PARTS = ("same", "fine", "rough", "mujoco", "methods", "policy")
Part = Literal["same", "fine", "rough", "mujoco", "methods", "policy"]


@dataclass(frozen=True)
class Args:
    """Flags."""

    seeds: int = 20
    """Robots that are identified on the simulator that recorded them."""
    others: int = 1
    """Robots of each part whose truth is not that of the model: fine, rough, mujoco. Figures are of the first."""
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
        if self.seeds < 1 or self.others < 1 or self.jumps < 3:
            raise InputError(
                f"need at least 1 seed, 1 other and 3 jumps, got {self.seeds}, {self.others}, {self.jumps}"
            )


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
        log = run_jumps(policy.act, env, np.linspace(0.5, 1.0, args.jumps))
        apexes[name] = (log.apex, log.commanded, log.reached)
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
    replay = Replay(device="cpu", threads=args.threads)
    replay_one = Replay(device="cpu", threads=1)

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
            found_of = []
            for seed in range(100, 100 + args.others):
                figures, _ = run_case(parameters, make_case(parameters, seed, carry, replay), replay, model, dt)
                found_of.append(figures)
                print(part, {name: round(value, 4) for name, value in figures.items()}, flush=True)
            values |= {f"{part}_{name}": value for name, value in found_of[0].items()}
            for name in ("coverage", "identified"):
                values[f"{part}_{name}_of_seeds"] = [figures[name] for figures in found_of]
    if "methods" in args.parts and last:
        values |= compare_methods(parameters, last[0], replay, ours, last[1].seconds)
    if "policy" in args.parts and last:
        values |= policy_errors(args, *last, folder)
    write_metrics(folder, values)
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
